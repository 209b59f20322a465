# Equations and symbols from the docstrings: fails when one of the paper's equations has no function or no test.
rule tables:
    input:
        "data/symbols.yaml",
        tests=sorted(str(path) for path in Path("tests").rglob("test_*.py")),
    output:
        equations=report(
            f"{OUT}/docs/equations.html",
            caption="../report/equations.rst",
            category="Tables",
            labels={"dataset": "{dataset}", "table": "equations"},
        ),
        symbols=report(
            f"{OUT}/docs/symbols.html",
            caption="../report/symbols.rst",
            category="Tables",
            labels={"dataset": "{dataset}", "table": "symbols"},
        ),
    log:
        f"{OUT}/logs/tables.log",
    benchmark:
        f"{OUT}/benchmarks/tables.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=lambda wildcards, output: str(Path(output.equations).parent),
        code=code(*COMMANDS),
    message:
        "Tables of equations and symbols"
    shell:
        "spotcheck equations --symbols data/symbols.yaml --tests tests --output {params.folder:q} 2>&1 | tee {log:q}"


rule report:
    input:
        manifest,
        instrument,
        results,
        rules.tables.output,
        paper_tables,
        notebook_pages,
        views,
        figures=rules.figures.output,
    output:
        report(
            f"{OUT}/report.html",
            caption="../report/report.rst",
            category="Report",
            labels={"dataset": "{dataset}", "page": "all of it"},
        ),
    log:
        f"{OUT}/logs/report.log",
    benchmark:
        f"{OUT}/benchmarks/report.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        results=results_folder,
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("report"),
    message:
        "Writing the report of {wildcards.dataset}"
    shell:
        "spotcheck report --dataset {params.folder:q} --results {params.results:q} --output {output:q}"
        " {params.vocabulary:q} 2>&1 | tee {log:q}"

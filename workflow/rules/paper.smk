# The paper's numbers against ours: for the default dataset, which was made to be compared with it.
rule paper:
    input:
        numbers="data/published.yaml",
        seeds="data/published_seeds.csv",
        instrument=instrument,
        results=results,
    output:
        table=f"{OUT}/paper_numbers.csv",
        summary=f"{OUT}/docs/paper_numbers.md",
        page=report(
            f"{OUT}/paper_numbers.html",
            caption="../report/paper_numbers.rst",
            category="Paper numbers",
            labels={"dataset": "{dataset}", "table": "all numbers"},
        ),
    log:
        f"{OUT}/logs/paper.log",
    benchmark:
        f"{OUT}/benchmarks/paper.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        results=results_folder,
        code=code("paper"),
    message:
        "Comparing the numbers of the paper with {wildcards.dataset}"
    shell:
        "spotcheck paper {input.numbers:q} --seeds {input.seeds:q} --dataset {params.folder:q} --results {params.results:q}"
        " --table {output.table:q} --page {output.page:q} --summary {output.summary:q} 2>&1 | tee {log:q}"

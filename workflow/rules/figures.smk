rule figures:
    input:
        manifest,
        instrument,
        results,
        simulated_results,
    output:
        report(
            directory(f"{OUT}/figures"),
            patterns=["{name}.svg"],
            caption="../report/figure.rst",
            category="Figures",
            labels={"dataset": "{dataset}", "figure": "{name}"},
        ),
    log:
        f"{OUT}/logs/figures.log",
    benchmark:
        f"{OUT}/benchmarks/figures.tsv"
    threads: 1
    resources:
        mem_mb=memory(800),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        results=results_folder,
        code=code("figures"),
    message:
        "Drawing every figure of {wildcards.dataset}"
    shell:
        "spotcheck figures --results {params.results:q} --dataset {params.folder:q} --output {output:q} 2>&1 | tee {log:q}"


# Fig. 6 of the paper: the chain itself. Snakemake is asked for the graph of the rules of this very run.
rule chain:
    output:
        picture=report(
            f"{OUT}/chain/fig06.svg",
            caption="../report/chain.rst",
            category="Figures",
            labels={"dataset": "{dataset}", "figure": "fig06"},
        ),
        preview=f"{OUT}/chain/fig06.png",
    log:
        f"{OUT}/logs/chain.log",
    benchmark:
        f"{OUT}/benchmarks/chain.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        dataset=dataset_folder,
        results=lambda wildcards: config["results"],
        base=lambda wildcards, output: output.picture.removesuffix(".svg"),
        snakefile=str(workflow.main_snakefile),
        rules=RULES,
        code=code("chain"),
    message:
        "Drawing the rule graph of {wildcards.dataset}"
    shell:
        "snakemake --forceall --rulegraph dot --nolock --quiet all --snakefile {params.snakefile:q}"
        " --config dataset={params.dataset:q} datasets=[] results={params.results:q} 2> {log:q} > {params.base:q}.dot"
        " && spotcheck chain {params.base:q}.dot --output {params.base:q} 2>&1 | tee --append {log:q}"

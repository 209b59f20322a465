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

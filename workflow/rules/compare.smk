rule compare:
    input:
        lambda wildcards: [file for name in compared() for file in compared_files(name)],
    output:
        page=f"{config['results']}/comparison.html",
        table=f"{config['results']}/comparison.nc",
    log:
        f"{config['results']}/logs/compare.log",
    benchmark:
        f"{config['results']}/benchmarks/compare.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folders=[OUT.format(dataset=name) for name in DATASETS],
        code=code("compare"),
    message:
        "Comparing {params.folders}"
    shell:
        "spotcheck compare {params.folders:q} --page {output.page:q} --output {output.table:q} 2>&1 | tee {log:q}"

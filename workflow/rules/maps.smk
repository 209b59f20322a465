rule maps:
    input:
        manifest,
        instrument,
        table=rules.ingest.output,
    output:
        f"{OUT}/maps.nc",
    log:
        f"{OUT}/logs/maps.log",
    benchmark:
        f"{OUT}/benchmarks/maps.tsv"
    threads: 1
    resources:
        mem_mb=memory(1000),
        runtime=minutes(30),
    params:
        folder=dataset_folder,
        code=code("maps"),
    message:
        "Mapping the pixels of {wildcards.dataset}"
    shell:
        "spotcheck maps {params.folder:q} --frames {input.table:q} --output {output:q} 2>&1 | tee {log:q}"

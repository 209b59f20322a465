rule transfer:
    input:
        manifest,
        instrument,
        table=rules.ingest.output,
    output:
        f"{OUT}/transfer.nc",
    log:
        f"{OUT}/logs/transfer.log",
    benchmark:
        f"{OUT}/benchmarks/transfer.tsv"
    threads: 1
    resources:
        mem_mb=memory(1000),
        runtime=minutes(30),
    params:
        folder=dataset_folder,
        code=code("transfer"),
    message:
        "Photon transfer of {wildcards.dataset}"
    shell:
        "spotcheck transfer {params.folder:q} --frames {input.table:q} --output {output:q} 2>&1 | tee {log:q}"

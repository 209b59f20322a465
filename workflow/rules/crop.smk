rule crop:
    input:
        manifest,
        instrument,
        # Stands for the frames, whose digests it holds: Snakemake looks at every input of every job that waits.
        table=rules.ingest.output,
    output:
        f"{OUT}/crops.nc",
    log:
        f"{OUT}/logs/crop.log",
    benchmark:
        f"{OUT}/benchmarks/crop.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        code=code("crop"),
    message:
        "Cropping every spot of {wildcards.dataset}"
    shell:
        "spotcheck crop {params.folder:q} --frames {input.table:q} --output {output:q} 2>&1 | tee {log:q}"

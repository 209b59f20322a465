rule crop:
    message:
        "Cropping every spot of {DATASET.name}"
    input:
        MANIFEST,
        INSTRUMENT,
        FRAMES,
        table=rules.ingest.output,
    output:
        f"{OUT}/crops.nc",
    params:
        folder=str(DATASET.folder),
        code=code("crop"),
    log:
        f"{OUT}/logs/crop.log",
    benchmark:
        f"{OUT}/benchmarks/crop.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    shell:
        "spotcheck crop {params.folder:q} --frames {input.table:q} --output {output:q} 2>&1 | tee {log:q}"

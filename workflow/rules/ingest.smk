rule ingest:
    message:
        "Recording every frame of {DATASET.name}"
    input:
        MANIFEST,
        INSTRUMENT,
        frames=FRAMES,
    output:
        update(f"{OUT}/frames.nc"),
    params:
        folder=str(DATASET.folder),
        code=code("ingest"),
    log:
        f"{OUT}/logs/ingest.log",
    benchmark:
        f"{OUT}/benchmarks/ingest.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    shell:
        "spotcheck ingest {params.folder:q} --output {output:q} 2>&1 | tee {log:q}"

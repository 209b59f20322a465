rule ingest:
    input:
        manifest,
        instrument,
        content_note,
        frames=frames,
    output:
        update(f"{OUT}/frames.nc"),
    log:
        f"{OUT}/logs/ingest.log",
    benchmark:
        f"{OUT}/benchmarks/ingest.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        content=content,
        code=code("ingest"),
    message:
        "Recording every frame of {wildcards.dataset}"
    shell:
        "spotcheck ingest {params.folder:q} --output {output:q} 2>&1 | tee {log:q}"

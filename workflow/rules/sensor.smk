rule sensor:
    message:
        "Settling the sensor of {DATASET.name}"
    input:
        MANIFEST,
        INSTRUMENT,
        table=rules.ingest.output,
        crops=rules.crop.output,
    output:
        f"{OUT}/sensor.nc",
    params:
        folder=str(DATASET.folder),
        code=code("sensor"),
    log:
        f"{OUT}/logs/sensor.log",
    benchmark:
        f"{OUT}/benchmarks/sensor.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    shell:
        "spotcheck sensor {params.folder:q} --crops {input.crops:q} --frames {input.table:q} --output {output:q}"
        " 2>&1 | tee {log:q}"

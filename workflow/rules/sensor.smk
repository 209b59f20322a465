rule sensor:
    input:
        manifest,
        instrument,
        table=rules.ingest.output,
        crops=rules.crop.output,
        transfer=transfer_file,
    output:
        f"{OUT}/sensor.nc",
    log:
        f"{OUT}/logs/sensor.log",
    benchmark:
        f"{OUT}/benchmarks/sensor.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        code=code("sensor"),
    message:
        "Settling the sensor of {wildcards.dataset}"
    shell:
        "spotcheck sensor {params.folder:q} --crops {input.crops:q} --frames {input.table:q}"
        " --transfer {input.transfer:q} --output {output:q} 2>&1 | tee {log:q}"

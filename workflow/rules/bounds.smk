rule bounds:
    input:
        manifest,
        instrument,
        calibration=rules.calibrate.output,
        sensor=rules.sensor.output,
    output:
        f"{OUT}/bounds.nc",
    log:
        f"{OUT}/logs/bounds.log",
    benchmark:
        f"{OUT}/benchmarks/bounds.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        code=code("bounds"),
    message:
        "Cramér-Rao bounds of {wildcards.dataset}"
    shell:
        "spotcheck bounds {params.folder:q} --calibration {input.calibration:q} --sensor {input.sensor:q}"
        " --output {output:q} 2>&1 | tee {log:q}"

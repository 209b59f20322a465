rule bounds:
    message:
        "Cramér-Rao bounds of {DATASET.name}"
    input:
        MANIFEST,
        INSTRUMENT,
        calibration=rules.calibrate.output,
        sensor=rules.sensor.output,
    output:
        f"{OUT}/bounds.nc",
    params:
        folder=str(DATASET.folder),
        code=code("bounds"),
    log:
        f"{OUT}/logs/bounds.log",
    benchmark:
        f"{OUT}/benchmarks/bounds.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    shell:
        "spotcheck bounds {params.folder:q} --calibration {input.calibration:q} --sensor {input.sensor:q}"
        " --output {output:q} 2>&1 | tee {log:q}"

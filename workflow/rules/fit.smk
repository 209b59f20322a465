rule fit:
    message:
        "Fitting every crop of {DATASET.name}"
    input:
        crops=rules.crop.output,
        sensor=rules.sensor.output,
    output:
        f"{OUT}/fits.nc",
    params:
        code=code("fit"),
    log:
        f"{OUT}/logs/fit.log",
    benchmark:
        f"{OUT}/benchmarks/fit.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    shell:
        "spotcheck fit {input.crops:q} --sensor {input.sensor:q} --output {output:q} 2>&1 | tee {log:q}"

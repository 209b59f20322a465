rule metrics:
    input:
        crops=[rules.crop.output, rules.crop_simulated.output],
        fits=[rules.fit.output, rules.fit_simulated.output],
        sensor=rules.sensor.output,
    output:
        f"{OUT}/metrics.nc",
    log:
        f"{OUT}/logs/metrics.log",
    benchmark:
        f"{OUT}/benchmarks/metrics.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        code=code("metrics"),
    message:
        "Metrics of measured and simulated frames of {wildcards.dataset}"
    shell:
        "spotcheck metrics --crops {input.crops:q} --fits {input.fits:q} --sensor {input.sensor:q} --output {output:q}"
        " 2>&1 | tee {log:q}"

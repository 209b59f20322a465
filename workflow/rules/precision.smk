rule precision:
    input:
        manifest,
        instrument,
        fits=[rules.fit.output[0], rules.fit_simulated.output[0]],
        calibration=rules.calibrate.output,
        sensor=rules.sensor.output,
    output:
        f"{OUT}/precision.nc",
    log:
        f"{OUT}/logs/precision.log",
    benchmark:
        f"{OUT}/benchmarks/precision.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        code=code("precision"),
    message:
        "Scatter and bounds of {wildcards.dataset}"
    shell:
        "spotcheck precision {params.folder:q} --fits {input.fits:q} --calibration {input.calibration:q}"
        " --sensor {input.sensor:q} --output {output:q} 2>&1 | tee {log:q}"

rule calibrate:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        fits=rules.fit.output,
        sensor=rules.sensor.output,
    output:
        f"{OUT}/calibration.nc",
    log:
        f"{OUT}/logs/calibrate.log",
    benchmark:
        f"{OUT}/benchmarks/calibrate.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        code=code("calibrate"),
    message:
        "Calibrating p1 and p2 of {wildcards.dataset}"
    shell:
        "spotcheck calibrate {params.folder:q} --crops {input.crops:q} --fits {input.fits:q} --sensor {input.sensor:q}"
        " --output {output:q} 2>&1 | tee {log:q}"

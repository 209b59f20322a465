rule simulate:
    input:
        manifest,
        instrument,
        calibration=rules.calibrate.output,
        fits=rules.fit.output,
        sensor=rules.sensor.output,
    output:
        images=f"{OUT}/simulated.nc",
        contract=[f"{OUT}/simulated/manifest.csv", f"{OUT}/simulated/instrument.yaml"],
        frames=f"{OUT}/simulated/{STACK}",
    log:
        f"{OUT}/logs/simulate.log",
    benchmark:
        f"{OUT}/benchmarks/simulate.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        simulated=simulated_folder,
        seed=config["seed"],
        code=code("simulate"),
    message:
        "Simulating every frame of {wildcards.dataset}"
    shell:
        "spotcheck simulate {params.folder:q} --calibration {input.calibration:q} --fits {input.fits:q}"
        " --sensor {input.sensor:q} --seed {params.seed} --folder {params.simulated:q} --output {output.images:q}"
        " 2>&1 | tee {log:q}"

# What each model expects of each measured frame: the report shows them side by side.
rule views:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        fits=rules.fit.output,
        calibration=rules.calibrate.output,
        sensor=rules.sensor.output,
        model=rules.judge.output.model,
        light=rules.judge.output.light,
    output:
        f"{OUT}/views.nc",
    log:
        f"{OUT}/logs/views.log",
    benchmark:
        f"{OUT}/benchmarks/views.tsv"
    wildcard_constraints:
        dataset=one_of(SPOTS),
    threads: 2
    resources:
        mem_mb=memory(2000),
        runtime=minutes(30),
    params:
        folder=dataset_folder,
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("views"),
    message:
        "Setting the models beside every frame of {wildcards.dataset}"
    shell:
        # One thread of BLAS, whatever the number of workers: sums in another order are other sums in the last digit.
        "OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 spotcheck views {params.folder:q} --crops {input.crops:q}"
        " --fits {input.fits:q} --calibration {input.calibration:q} --sensor {input.sensor:q} --model {input.model:q}"
        " --output {output:q} {params.vocabulary:q} 2>&1 | tee {log:q}"

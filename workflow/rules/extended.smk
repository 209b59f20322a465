# The design once more under the model that the verdict extended, evaluated as the measured frames are.
rule extended:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        fits=rules.fit.output,
        sensor=rules.sensor.output,
        metrics=rules.metrics.output,
        model=rules.judge.output.model,
        light=rules.judge.output.light,
    output:
        images=f"{OUT}/extended.nc",
        metrics=f"{OUT}/extended_metrics.nc",
        table=f"{OUT}/model_comparison.csv",
        # Simulated frames as a dataset, with their crops and fits; empty without a model.
        folder=directory(f"{OUT}/extended"),
    log:
        f"{OUT}/logs/extended.log",
    benchmark:
        f"{OUT}/benchmarks/extended.tsv"
    wildcard_constraints:
        dataset=one_of(SPOTS),
    threads: 1
    resources:
        mem_mb=memory(800),
        runtime=minutes(30),
    params:
        folder=dataset_folder,
        seed=config["seed"],
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("extended", "simulate", "ingest", "crop", "fit", "metrics"),
    message:
        "Simulating and evaluating every frame of {wildcards.dataset} under its extended model"
    shell:
        "spotcheck extended {params.folder:q} --model {input.model:q} --sensor {input.sensor:q} --crops {input.crops:q}"
        " --fits {input.fits:q} --metrics {input.metrics:q} --seed {params.seed} --folder {output.folder:q}"
        " --images {output.images:q} --output {output.metrics:q} --table {output.table:q} {params.vocabulary:q}"
        " 2>&1 | tee {log:q}"

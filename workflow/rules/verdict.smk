rule discrepancy:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        sensor=rules.sensor.output,
    output:
        f"{OUT}/findings.json",
    log:
        f"{OUT}/logs/discrepancy.log",
    benchmark:
        f"{OUT}/benchmarks/discrepancy.tsv"
    threads: 2
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        folder=dataset_folder,
        calibrations=lambda wildcards: f"{config['results']}/_calibration",
        simulations=config["null_simulations"],
        seed=config["seed"],
        tolerance=json.dumps(config["tolerance"]),
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("discrepancy"),
    message:
        "Looking for what the model of {wildcards.dataset} is missing; a new design is calibrated first"
    shell:
        # One thread of BLAS, whatever the number of workers: sums in another order are other sums in the last digit.
        "OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 spotcheck discrepancy {params.folder:q} --crops {input.crops:q} --sensor {input.sensor:q}"
        " --calibrations {params.calibrations:q} --simulations {params.simulations} --seed {params.seed}"
        " --workers {threads} --tolerance {params.tolerance:q} --output {output:q} {params.vocabulary:q} 2>&1 | tee {log:q}"


rule verify:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        sensor=rules.sensor.output,
        findings=rules.discrepancy.output,
    output:
        f"{OUT}/gap.nc",
    log:
        f"{OUT}/logs/verify.log",
    benchmark:
        f"{OUT}/benchmarks/verify.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        folder=dataset_folder,
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("verify"),
    message:
        "Predicting unseen frames of {wildcards.dataset}"
    shell:
        "spotcheck verify {params.folder:q} --crops {input.crops:q} --sensor {input.sensor:q}"
        " --findings {input.findings:q} --output {output:q} {params.vocabulary:q} 2>&1 | tee {log:q}"


rule advise:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        sensor=rules.sensor.output,
        findings=rules.discrepancy.output,
    output:
        f"{OUT}/advice.json",
    log:
        f"{OUT}/logs/advise.log",
    benchmark:
        f"{OUT}/benchmarks/advise.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        folder=dataset_folder,
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("advise"),
    message:
        "Looking for the next measurement for {wildcards.dataset}"
    shell:
        "spotcheck advise {params.folder:q} --crops {input.crops:q} --sensor {input.sensor:q}"
        " --findings {input.findings:q} --output {output:q} {params.vocabulary:q} 2>&1 | tee {log:q}"


rule judge:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        sensor=rules.sensor.output,
        findings=rules.discrepancy.output,
        gap=rules.verify.output,
        advice=rules.advise.output,
    output:
        verdict=f"{OUT}/verdict.json",
        pictures=f"{OUT}/discrepancy.nc",
        model=f"{OUT}/model.yaml",
    log:
        f"{OUT}/logs/judge.log",
    benchmark:
        f"{OUT}/benchmarks/judge.tsv"
    wildcard_constraints:
        dataset=one_of(SPOTS),
    threads: 1
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        folder=dataset_folder,
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("verdict"),
    message:
        "Writing the verdict on {wildcards.dataset}"
    shell:
        "spotcheck verdict {params.folder:q} --crops {input.crops:q} --sensor {input.sensor:q}"
        " --findings {input.findings:q} --gap {input.gap:q} --advice {input.advice:q}"
        " --pictures {output.pictures:q} --model {output.model:q} --output {output.verdict:q} {params.vocabulary:q} 2>&1 | tee {log:q}"


# Without a spot flats and darks speak for themselves.
rule judge_flats:
    input:
        manifest,
        instrument,
        table=rules.ingest.output,
    output:
        verdict=f"{OUT}/verdict.json",
    log:
        f"{OUT}/logs/judge_flats.log",
    benchmark:
        f"{OUT}/benchmarks/judge_flats.tsv"
    wildcard_constraints:
        dataset=one_of(NO_SPOTS),
    threads: 1
    resources:
        mem_mb=500,
        runtime=30,
    params:
        folder=dataset_folder,
        tolerance=json.dumps(config["tolerance"]),
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("flats"),
    message:
        "Writing the verdict on {wildcards.dataset}"
    shell:
        "OPENBLAS_NUM_THREADS=1 spotcheck flats {params.folder:q} --frames {input.table:q}"
        " --tolerance {params.tolerance:q} --output {output.verdict:q} {params.vocabulary:q} 2>&1 | tee {log:q}"

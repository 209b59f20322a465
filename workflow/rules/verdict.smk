rule judge:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        fits=rules.fit.output,
        sensor=rules.sensor.output,
    output:
        verdict=f"{OUT}/verdict.json",
        pictures=f"{OUT}/discrepancy.nc",
        model=f"{OUT}/model.yaml",
        light=f"{OUT}/light.nc",
    log:
        f"{OUT}/logs/judge.log",
    benchmark:
        f"{OUT}/benchmarks/judge.tsv"
    wildcard_constraints:
        dataset=one_of(SPOTS),
    # It keeps little more than one core busy.
    threads: 1
    resources:
        mem_mb=memory(2000),
        runtime=minutes(60),
    params:
        folder=dataset_folder,
        tolerance=json.dumps(config["tolerance"]),
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("judge"),
    message:
        "Looking for what the model of {wildcards.dataset} is missing"
    shell:
        # One thread of BLAS, whatever the number of workers: sums in another order are other sums in the last digit.
        "OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 spotcheck judge {params.folder:q} --crops {input.crops:q}"
        " --fits {input.fits:q} --sensor {input.sensor:q} --tolerance {params.tolerance:q} --pictures {output.pictures:q} --model {output.model:q}"
        " --light {output.light:q} --output {output.verdict:q} {params.vocabulary:q} 2>&1 | tee {log:q}"


# Without a spot flats and darks speak for themselves.
rule flats:
    input:
        manifest,
        instrument,
        table=rules.ingest.output,
    output:
        verdict=f"{OUT}/verdict.json",
    log:
        f"{OUT}/logs/flats.log",
    benchmark:
        f"{OUT}/benchmarks/flats.tsv"
    wildcard_constraints:
        dataset=one_of(NO_SPOTS),
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(30),
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

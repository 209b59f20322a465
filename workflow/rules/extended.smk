# The design once more under the model that the verdict extended; nothing else waits for it.
rule simulate_extended:
    input:
        manifest,
        instrument,
        sensor=rules.sensor.output,
        model=rules.judge.output.model,
        light=rules.judge.output.light,
    output:
        images=f"{OUT}/extended.nc",
        contract=[f"{OUT}/extended/manifest.csv", f"{OUT}/extended/instrument.yaml"],
        frames=f"{OUT}/extended/{STACK}",
    log:
        f"{OUT}/logs/simulate_extended.log",
    benchmark:
        f"{OUT}/benchmarks/simulate_extended.tsv"
    wildcard_constraints:
        dataset=one_of(SPOTS),
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(30),
    params:
        folder=dataset_folder,
        extended=lambda wildcards: f"{results_folder(wildcards)}/extended",
        seed=config["seed"],
        vocabulary=VOCABULARY,
        own_effects=OWN_EFFECTS,
        code=code("simulate"),
    message:
        "Simulating every frame of {wildcards.dataset} under its extended model"
    shell:
        "spotcheck simulate {params.folder:q} --model {input.model:q} --sensor {input.sensor:q} --seed {params.seed}"
        " --folder {params.extended:q} --output {output.images:q} {params.vocabulary:q} 2>&1 | tee {log:q}"

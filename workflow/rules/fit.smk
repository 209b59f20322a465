rule fit:
    input:
        manifest,
        instrument,
        crops=rules.crop.output,
        sensor=rules.sensor.output,
        maps=maps_file,
    output:
        f"{OUT}/fits.nc",
    log:
        f"{OUT}/logs/fit.log",
    benchmark:
        f"{OUT}/benchmarks/fit.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        code=code("fit"),
    message:
        "Fitting every crop of {wildcards.dataset}"
    shell:
        "spotcheck fit {params.folder:q} --crops {input.crops:q} --sensor {input.sensor:q} --maps {input.maps:q}"
        " --output {output:q} 2>&1 | tee {log:q}"

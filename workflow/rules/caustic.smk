rule caustic:
    input:
        manifest,
        instrument,
        fits=rules.fit.output,
    output:
        f"{OUT}/caustic.nc",
    log:
        f"{OUT}/logs/caustic.log",
    benchmark:
        f"{OUT}/benchmarks/caustic.tsv"
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        code=code("caustic"),
    message:
        "Beam caustic of {wildcards.dataset}"
    shell:
        "spotcheck caustic {params.folder:q} --fits {input.fits:q} --output {output:q} 2>&1 | tee {log:q}"

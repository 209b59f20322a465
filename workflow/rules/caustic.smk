rule caustic:
    message:
        "Beam caustic of {DATASET.name}"
    input:
        MANIFEST,
        INSTRUMENT,
        fits=rules.fit.output,
    output:
        f"{OUT}/caustic.nc",
    params:
        folder=str(DATASET.folder),
        code=code("caustic"),
    log:
        f"{OUT}/logs/caustic.log",
    benchmark:
        f"{OUT}/benchmarks/caustic.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    shell:
        "spotcheck caustic {params.folder:q} --fits {input.fits:q} --output {output:q} 2>&1 | tee {log:q}"

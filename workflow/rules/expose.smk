# The virtual rig: raw frames from first principles. It shares no code with the library.
if HAS_RIG:

    rule expose:
        input:
            manifest=MANIFEST,
            settings=str(DATASET.folder / "rig.yaml"),
        output:
            frames=FRAMES,
            truth=str(DATASET.folder / "truth.json"),
        log:
            f"{OUT}/logs/expose.log",
        benchmark:
            f"{OUT}/benchmarks/expose.tsv"
        threads: 2
        resources:
            mem_mb=900,
            runtime=10,
        params:
            folder=dataset_folder,
            code=code_digest("rig.expose"),
        message:
            "Exposing {DATASET.name} on the virtual rig"
        shell:
            "rig expose {params.folder:q} --settings {input.settings:q} --truth {output.truth:q}"
            " --workers {threads} 2>&1 | tee {log:q}"

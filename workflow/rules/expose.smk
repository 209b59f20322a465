# The virtual rig: raw frames from first principles. It shares no code with the library. Each plan names frames of its own,
# so each has a rule of its own.
for name, planned in {name: found for name, found in DATASETS.items() if has_rig(found)}.items():

    rule:
        name:
            "expose" if len(DATASETS) == 1 else f"expose_{name}"
        input:
            manifest=f"{planned.folder}/manifest.csv",
            settings=f"{planned.folder}/rig.yaml",
        output:
            frames=frames_of(planned),
            truth=f"{planned.folder}/truth.json",
        log:
            f"{config['results']}/{name}/logs/expose.log",
        benchmark:
            f"{config['results']}/{name}/benchmarks/expose.tsv"
        threads: 2
        resources:
            mem_mb=memory(900),
            runtime=minutes(10),
        params:
            folder=lambda wildcards, input: str(Path(input.manifest).parent),
            content=[file_digest(planned.folder / own)[:12] for own in ("manifest.csv", "rig.yaml")],
            code=code_digest("rig.expose"),
        message:
            f"Exposing {name} on the virtual rig"
        shell:
            "rig expose {params.folder:q} --settings {input.settings:q} --truth {output.truth:q}"
            " --workers {threads} 2>&1 | tee {log:q}"

# Executed notebooks are results. Each appears whole: papermill writes as it goes, so it writes beside.
rule notebook:
    input:
        MANIFEST,
        INSTRUMENT,
        RESULTS,
        source="notebooks/{notebook}.ipynb",
    output:
        f"{OUT}/notebooks/{{notebook}}.ipynb",
    log:
        f"{OUT}/logs/notebook_{{notebook}}.log",
    benchmark:
        f"{OUT}/benchmarks/notebook_{{notebook}}.tsv"
    wildcard_constraints:
        notebook="|".join(NOTEBOOKS),
    conda:
        "../envs/spotcheck.yaml"
    threads: 1
    resources:
        mem_mb=800,
        runtime=10,
    params:
        folder=dataset_folder,
        results=lambda wildcards: str(Path(OUT).resolve()),
        scratch=lambda wildcards, output: str(Path(output[0]).with_suffix(".part.ipynb")),
        code=lambda wildcards: notebook_code(wildcards.notebook),
    message:
        "Executing notebook {wildcards.notebook} on {DATASET.name}"
    shell:
        "papermill {input.source:q} {params.scratch:q} -k python3 --no-progress-bar"
        " -p dataset {params.folder:q} -p results {params.results:q} &> {log:q} || {{ cat {log:q} >&2; exit 1; }}"
        "; mv {params.scratch:q} {output:q}"

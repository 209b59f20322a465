# Executed notebooks are results. Each appears whole: papermill writes as it goes, so it writes beside.
# A kernel may fail to start: its ports are drawn before they are bound (nteract/papermill#511), and a busy machine takes
# longer than the minute that papermill waits.
rule notebook:
    input:
        manifest,
        instrument,
        results,
        source="notebooks/{notebook}.ipynb",
    output:
        f"{OUT}/notebooks/{{notebook}}.ipynb",
    log:
        f"{OUT}/logs/notebook_{{notebook}}.log",
    benchmark:
        f"{OUT}/benchmarks/notebook_{{notebook}}.tsv"
    wildcard_constraints:
        notebook="|".join(NOTEBOOKS),
    retries: 1
    threads: 1
    resources:
        mem_mb=memory(800),
        runtime=minutes(10),
    params:
        folder=dataset_folder,
        results=lambda wildcards: str(Path(results_folder(wildcards)).resolve()),
        scratch=lambda wildcards, output: str(Path(output[0]).with_suffix(".part.ipynb")),
        code=lambda wildcards: notebook_code(wildcards.notebook),
    message:
        "Executing notebook {wildcards.notebook} on {wildcards.dataset}"
    shell:
        "papermill {input.source:q} {params.scratch:q} -k python3 --no-progress-bar --start-timeout 300"
        " -p dataset {params.folder:q} -p results {params.results:q} &> {log:q} || {{ cat {log:q} >&2; exit 1; }}"
        "; mv {params.scratch:q} {output:q}"

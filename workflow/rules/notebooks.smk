# Executed notebooks are results, as notebook and as page. Each appears whole: it is written
# under another name, since papermill writes while it runs. The page loads nothing from the network.
# A kernel may fail to start: its ports are drawn before they are bound (nteract/papermill#511), and a busy machine takes
# longer than the minute that papermill waits.
rule notebook:
    input:
        manifest,
        instrument,
        results,
        source="notebooks/{notebook}.ipynb",
    output:
        notebook=f"{OUT}/notebooks/{{notebook}}.ipynb",
        page=f"{OUT}/notebooks/{{notebook}}.html",
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
        scratch=lambda wildcards, output: str(Path(output.notebook).with_suffix(".part.ipynb")),
        scratch_page=lambda wildcards, output: str(Path(output.page).with_suffix(".part.html")),
        code=lambda wildcards: notebook_code(wildcards.notebook),
    message:
        "Executing notebook {wildcards.notebook} on {wildcards.dataset}"
    shell:
        "papermill {input.source:q} {params.scratch:q} -k python3 --no-progress-bar --start-timeout 300"
        " -p dataset {params.folder:q} -p results {params.results:q} &> {log:q} || {{ cat {log:q} >&2; exit 1; }}"
        "; mv {params.scratch:q} {output.notebook:q}"
        "; python -m nbconvert --to html --log-level WARN --HTMLExporter.mathjax_url= --HTMLExporter.require_js_url="
        " --HTMLExporter.jquery_url= --stdout {output.notebook:q} > {params.scratch_page:q} 2>> {log:q}"
        " || {{ cat {log:q} >&2; exit 1; }}; mv {params.scratch_page:q} {output.page:q}"

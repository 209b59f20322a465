# What can be asked for, and the stages in the order in which the data flow.
from snakemake.utils import min_version

min_version("9.20")


configfile: "config/config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/running.smk"
include: "workflow/rules/expose.smk"
include: "workflow/rules/ingest.smk"
include: "workflow/rules/crop.smk"
include: "workflow/rules/transfer.smk"
include: "workflow/rules/sensor.smk"
include: "workflow/rules/maps.smk"
include: "workflow/rules/fit.smk"
include: "workflow/rules/calibrate.smk"
include: "workflow/rules/simulate.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/metrics.smk"
include: "workflow/rules/bounds.smk"
include: "workflow/rules/precision.smk"
include: "workflow/rules/caustic.smk"
include: "workflow/rules/verdict.smk"
include: "workflow/rules/extended.smk"
include: "workflow/rules/views.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/paper.smk"
include: "workflow/rules/notebooks.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/compare.smk"


rule all:
    default_target: True
    input:
        expand(rules.report.output, dataset=DATASETS),
        expand(rules.notebook.output, dataset=SPOTS, notebook=NOTEBOOKS),


rule paper_numbers:
    input:
        expand(rules.paper.output, dataset=SPOTS),


rule verdict:
    input:
        expand(rules.judge.output.verdict, dataset=DATASETS),


rule extended_models:
    input:
        expand(rules.extended.output.images, dataset=SPOTS),

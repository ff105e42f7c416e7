from pathlib import Path

from snakemake.utils import min_version

min_version("9.19")


configfile: Path(workflow.basedir) / "config" / "evidence.yaml"
configfile:
    "config.yaml"
    if Path("config.yaml").exists()
    else Path(workflow.basedir) / "config.yaml"


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/data.smk"
include: "workflow/rules/stage1.smk"
include: "workflow/rules/priors.smk"
include: "workflow/rules/stage2.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/registration.smk"
include: "workflow/rules/pretraining.smk"
include: "workflow/rules/evidence.smk"


rule all:
    default_target: True
    input:
        FILES.report,
        [FILES.table(table, "md") for table in TABLES],
        [FILES.figure(figure, "png") for figure in FIGURES],
        PLAN.all_kept(),

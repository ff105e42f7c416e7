# Stage 1: the backbone on the data term alone.


rule stage1:
    input:
        pairs=rules.pairs.output,
    output:
        **trained(STAGE1),
    log:
        FILES.log("{dataset}", "{backbone}", "stage1"),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "stage1")
    priority: 10
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        backbone=lambda wildcards: PLAN.network(wildcards.backbone),
        settings=lambda wildcards: PLAN.stage1(wildcards.backbone),
        seed=lambda wildcards: PLAN.seed(wildcards.backbone),
        compute=COMPUTE,
        code=lambda wildcards: PLAN.code(
            "stage1", wildcards.backbone, data_term=CONFIG.stage1.data_term
        ),
    shell:
        "dine --log {log:q} --threads {threads} stage1 --pairs {input.pairs:q}"
        " --backbone {params.backbone:q} --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes}"
        " --name '{wildcards.dataset}/{wildcards.backbone}/stage1'"
        ' --out "$(dirname -- {output.model:q})"'


rule fields:
    input:
        model=rules.stage1.output.model,
        pairs=rules.pairs.output,
    output:
        FILES.fields("{dataset}", "{backbone}"),
    log:
        FILES.log("{dataset}", "{backbone}", "fields"),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "fields")
    priority: 20
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        targets="",
        name="{dataset}/{backbone}/fields",
        batch=CONFIG.evaluation.batch_size,
        compute=COMPUTE,
        code=lambda wildcards: PLAN.code("fields", wildcards.backbone),
    shell:
        "dine --log {log:q} --threads {threads} fields --model {input.model:q}"
        " --pairs {input.pairs:q} {params.targets} --batch-size {params.batch} {params.compute}"
        " --name '{params.name}' --out {output:q}"

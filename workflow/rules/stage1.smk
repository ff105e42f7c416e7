# Stage 1: the backbone on the data term alone.


rule stage1:
    input:
        pairs=rules.pairs.output,
    output:
        model=RESULTS / "{dataset}" / "{backbone}" / "stage1" / "model.safetensors",
        history=RESULTS / "{dataset}" / "{backbone}" / "stage1" / "history.csv",
        record=RESULTS / "{dataset}" / "{backbone}" / "stage1" / "run.json",
    log:
        LOGS / "{dataset}" / "{backbone}" / "stage1.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "stage1.tsv"
    priority: 10
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        backbone=backbone_settings,
        settings=stage1_settings,
        seed=training_seed,
        compute=COMPUTE,
        code=lambda wildcards: code_of(
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
        RESULTS / "{dataset}" / "{backbone}" / "dvf.h5",
    log:
        LOGS / "{dataset}" / "{backbone}" / "fields.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "fields.tsv"
    priority: 20
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        batch=CONFIG.evaluation.batch_size,
        compute=COMPUTE,
        code=lambda wildcards: code_of("fields", wildcards.backbone),
    shell:
        "dine --log {log:q} --threads {threads} fields --model {input.model:q}"
        " --pairs {input.pairs:q} --batch-size {params.batch} {params.compute}"
        " --name '{wildcards.dataset}/{wildcards.backbone}/fields' --out {output:q}"

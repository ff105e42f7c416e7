# Predictions first, then metrics from them.


rule predict:
    input:
        model=NETWORK.model,
        pairs=rules.pairs.output,
        variants=lambda wildcards: PLAN.variants(wildcards.dataset),
    output:
        NETWORK.predictions,
    log:
        FILES.log("{dataset}", "{backbone}", "{run}", "predict"),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "{run}", "predict")
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        variants=lambda wildcards, input: options("--variant", input.variants),
        name="{dataset}/{backbone}/{run}",
        batch=CONFIG.evaluation.batch_size,
        compute=COMPUTE,
        code=lambda wildcards: PLAN.code("predict", wildcards.backbone),
    shell:
        "dine --log {log:q} --threads {threads} predict --model {input.model:q}"
        " --pairs {input.pairs:q} {params.variants} --batch-size {params.batch}"
        " {params.compute} --name '{params.name}' --out {output:q}"


rule evaluate:
    input:
        predictions=rules.predict.output,
        pairs=rules.pairs.output,
        variants=lambda wildcards: PLAN.variants(wildcards.dataset),
    output:
        metrics=NETWORK.metrics,
        point_errors=NETWORK.point_errors,
    log:
        FILES.log("{dataset}", "{backbone}", "{run}", "evaluate"),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "{run}", "evaluate")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("evaluation"),
    params:
        variants=lambda wildcards, input: options("--variant", input.variants),
        method=lambda wildcards: wildcards.run.removeprefix("stage2/"),
        seed=CONFIG.seed,
        code=code_digest("evaluate"),
    shell:
        "dine --log {log:q} evaluate --predictions {input.predictions:q} --pairs {input.pairs:q}"
        " {params.variants} --dataset {wildcards.dataset} --backbone {wildcards.backbone}"
        " --method {params.method} --seed {params.seed} --point-errors {output.point_errors:q}"
        " --out {output.metrics:q}"

# Predictions first, then metrics from them.


rule predict:
    input:
        model=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "model.safetensors",
        pairs=rules.pairs.output,
        variants=variant_files,
    output:
        RESULTS / "{dataset}" / "{backbone}" / "{run}" / "predictions.h5",
    log:
        LOGS / "{dataset}" / "{backbone}" / "{run}" / "predict.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "{run}" / "predict.tsv"
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        variants=variant_options,
        batch=CONFIG.evaluation.batch_size,
        compute=COMPUTE,
        code=lambda wildcards: code_of("predict", wildcards.backbone),
    shell:
        "dine --log {log:q} --threads {threads} predict --model {input.model:q}"
        " --pairs {input.pairs:q} {params.variants} --batch-size {params.batch}"
        " {params.compute}"
        " --name '{wildcards.dataset}/{wildcards.backbone}/{wildcards.run}' --out {output:q}"


rule evaluate:
    input:
        predictions=rules.predict.output,
        pairs=rules.pairs.output,
        variants=variant_files,
    output:
        metrics=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "metrics.csv",
        point_errors=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "point_errors.h5",
    log:
        LOGS / "{dataset}" / "{backbone}" / "{run}" / "evaluate.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "{run}" / "evaluate.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("evaluation"),
    params:
        variants=variant_options,
        method=lambda wildcards: wildcards.run.removeprefix("stage2/"),
        seed=CONFIG.seed,
        code=code_digest("evaluate"),
    shell:
        "dine --log {log:q} evaluate --predictions {input.predictions:q} --pairs {input.pairs:q}"
        " {params.variants} --dataset {wildcards.dataset} --backbone {wildcards.backbone}"
        " --method {params.method} --seed {params.seed} --point-errors {output.point_errors:q}"
        " --out {output.metrics:q}"

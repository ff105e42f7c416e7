# Stage 2: from Stage 1, with λ times a prior, and the control with λ = 0.


rule stage2_control:
    input:
        pairs=rules.pairs.output,
        model=rules.stage1.output.model,
    output:
        **stage2_outputs(dine_config.CONTROL),
    log:
        LOGS / "{dataset}" / "{backbone}" / "stage2" / "lambda0.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "stage2" / "lambda0.tsv"
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        settings=section(CONFIG.stage2),
        seed=training_seed,
        compute=COMPUTE,
        code=lambda wildcards: code_of(
            "stage2", wildcards.backbone, data_term=CONFIG.stage2.data_term
        ),
    shell:
        "dine --log {log:q} --threads {threads} stage2 --pairs {input.pairs:q}"
        " --model {input.model:q} --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes}"
        " --name '{wildcards.dataset}/{wildcards.backbone}/lambda0'"
        ' --out "$(dirname -- {output.model:q})"'


rule stage2_prior:
    input:
        pairs=rules.pairs.output,
        model=rules.stage1.output.model,
        prior=RESULTS
        / "{dataset}"
        / "{backbone}"
        / "priors"
        / "{prior_of_stage2}.safetensors",
        weight=search_file,
    output:
        **stage2_outputs("{prior_of_stage2}"),
    log:
        LOGS / "{dataset}" / "{backbone}" / "stage2" / "{prior_of_stage2}.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "stage2" / "{prior_of_stage2}.tsv"
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        settings=section(CONFIG.stage2),
        seed=training_seed,
        compute=COMPUTE,
        code=lambda wildcards: code_of(
            "stage2",
            wildcards.backbone,
            data_term=CONFIG.stage2.data_term,
            priors=[wildcards.prior_of_stage2],
        ),
    shell:
        "dine --log {log:q} --threads {threads} stage2 --pairs {input.pairs:q}"
        " --model {input.model:q} --variant {wildcards.prior_of_stage2} --prior {input.prior:q}"
        " --lambda {input.weight:q} --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes}"
        " --name '{wildcards.dataset}/{wildcards.backbone}/{wildcards.prior_of_stage2}'"
        ' --out "$(dirname -- {output.model:q})"'

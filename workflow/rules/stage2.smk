# Stage 2: from Stage 1, with λ times a prior, and the control with λ = 0.


rule stage2_control:
    input:
        pairs=rules.pairs.output,
        model=rules.stage1.output.model,
    output:
        **trained(FILES.run("{dataset}", "{backbone}", dine_config.CONTROL)),
    log:
        FILES.log("{dataset}", "{backbone}", "stage2", dine_config.CONTROL),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "stage2", dine_config.CONTROL)
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        variant=dine_config.CONTROL,
        prior="",
        settings=section(CONFIG.stage2),
        seed=lambda wildcards: PLAN.seed(wildcards.backbone),
        compute=COMPUTE,
        code=lambda wildcards: PLAN.code(
            "stage2", wildcards.backbone, data_term=CONFIG.stage2.data_term
        ),
    shell:
        "dine --log {log:q} --threads {threads} stage2 --pairs {input.pairs:q}"
        " --model {input.model:q} --variant {params.variant} {params.prior}"
        " --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes}"
        " --name '{wildcards.dataset}/{wildcards.backbone}/{params.variant}'"
        ' --out "$(dirname -- {output.model:q})"'


use rule stage2_control as stage2_prior with:
    input:
        pairs=rules.pairs.output,
        model=rules.stage1.output.model,
        prior=FILES.prior("{dataset}", "{backbone}", "{prior_of_stage2}"),
        weight=lambda wildcards: PLAN.search_file(wildcards.backbone),
    output:
        **trained(FILES.run("{dataset}", "{backbone}", "{prior_of_stage2}")),
    log:
        FILES.log("{dataset}", "{backbone}", "stage2", "{prior_of_stage2}"),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "stage2", "{prior_of_stage2}")
    params:
        variant=lambda wildcards: wildcards.prior_of_stage2,
        prior=lambda wildcards, input: prior_options(input.prior, input.weight),
        code=lambda wildcards: PLAN.code(
            "stage2",
            wildcards.backbone,
            data_term=CONFIG.stage2.data_term,
            priors=[wildcards.prior_of_stage2],
        ),

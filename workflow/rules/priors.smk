# Priors, fitted to Stage-1 fields of the training split and frozen; the search of λ.


rule fit_prior:
    input:
        rules.fields.output,
    output:
        RESULTS / "{dataset}" / "{backbone}" / "priors" / "{prior}.safetensors",
    log:
        LOGS / "{dataset}" / "{backbone}" / "priors" / "{prior}.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "priors" / "{prior}.tsv"
    priority: 30
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prior"),
    params:
        settings=prior_settings,
        seed=training_seed,
        code=lambda wildcards: code_of("fit-prior", priors=[wildcards.prior]),
    shell:
        "dine --log {log:q} --threads {threads} fit-prior --fields {input:q}"
        " --settings {params.settings:q} --seed {params.seed} --out {output:q}"


rule search_lambda:
    input:
        pairs=FILES.dataset(SEARCH.dataset, "pairs.h5"),
        model=FILES.run(SEARCH.dataset, SEARCH.backbone, "stage1", "model.safetensors"),
        priors=searched_priors(SEARCH.backbone),
    output:
        FILES.search,
    log:
        LOGS / "search_lambda.log",
    benchmark:
        BENCHMARKS / "search_lambda.tsv"
    priority: 40
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        priors=lambda wildcards, input: options(
            "--prior", CONFIG.searched(SEARCH.backbone), input.priors
        ),
        stage2=section(CONFIG.stage2),
        settings=search_settings(SEARCH.backbone),
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=code_of(
            "search-lambda",
            SEARCH.backbone,
            data_term=CONFIG.stage2.data_term,
            priors=CONFIG.searched(SEARCH.backbone),
        ),
    shell:
        "dine --log {log:q} --threads {threads} search-lambda --pairs {input.pairs:q}"
        " --model {input.model:q} {params.priors} --stage2 {params.stage2:q}"
        " --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes}"
        " --out {output:q}"


# With a backbone of its own: `own_lambda`.
use rule search_lambda as search_own_lambda with:
    input:
        pairs=FILES.dataset(SEARCH.dataset, "pairs.h5"),
        model=RESULTS / SEARCH.dataset / "{searching}" / "stage1" / "model.safetensors",
        priors=lambda wildcards: searched_priors(wildcards.searching),
    output:
        RESULTS / "lambda" / "{searching}" / "lambda.json",
    log:
        LOGS / "search_lambda_{searching}.log",
    benchmark:
        BENCHMARKS / "search_lambda_{searching}.tsv"
    wildcard_constraints:
        searching="|".join(own_searches(CONFIG)) or NOTHING,
    params:
        priors=lambda wildcards, input: options(
            "--prior", CONFIG.searched(wildcards.searching), input.priors
        ),
        stage2=section(CONFIG.stage2),
        settings=lambda wildcards: search_settings(wildcards.searching),
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=lambda wildcards: code_of(
            "search-lambda",
            wildcards.searching,
            data_term=CONFIG.stage2.data_term,
            priors=CONFIG.searched(wildcards.searching),
        ),

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


SEARCH = CONFIG.lambda_search


rule search_lambda:
    input:
        pairs=FILES.dataset(SEARCH.dataset, "pairs.h5"),
        model=FILES.run(SEARCH.dataset, SEARCH.backbone, "stage1", "model.safetensors"),
        priors=[
            FILES.prior(SEARCH.dataset, SEARCH.backbone, prior)
            for prior in SEARCH.priors
        ],
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
        priors=lambda wildcards, input: options("--prior", SEARCH.priors, input.priors),
        stage2=section(CONFIG.stage2),
        settings=section(SEARCH),
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=code_of(
            "search-lambda",
            SEARCH.backbone,
            data_term=CONFIG.stage2.data_term,
            priors=SEARCH.priors,
        ),
    shell:
        "dine --log {log:q} --threads {threads} search-lambda --pairs {input.pairs:q}"
        " --model {input.model:q} {params.priors} --stage2 {params.stage2:q}"
        " --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes}"
        " --out {output:q}"

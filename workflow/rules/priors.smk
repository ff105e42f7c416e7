# Priors, fitted to Stage-1 fields of the training split and frozen; the search of λ.


rule fit_prior:
    input:
        rules.fields.output,
    output:
        FILES.prior("{dataset}", "{backbone}", "{prior}"),
    log:
        FILES.log("{dataset}", "{backbone}", "priors", "{prior}"),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "priors", "{prior}")
    priority: 30
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prior"),
    params:
        fields=lambda wildcards, input: options("--fields", input),
        settings=lambda wildcards: PLAN.prior(wildcards.prior),
        seed=lambda wildcards: PLAN.seed(wildcards.backbone),
        code=lambda wildcards: PLAN.code("fit-prior", priors=[wildcards.prior]),
    shell:
        "dine --log {log:q} --threads {threads} fit-prior {params.fields}"
        " --settings {params.settings:q} --seed {params.seed} --out {output:q}"


rule search_lambda:
    input:
        pairs=FILES.data(SEARCH.dataset).pairs,
        model=FILES.run(SEARCH.dataset, SEARCH.backbone, "stage1").model,
        priors=PLAN.searched_priors(SEARCH.backbone),
    output:
        FILES.search,
    log:
        FILES.log("search_lambda"),
    benchmark:
        FILES.benchmark("search_lambda")
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
        settings=PLAN.search(SEARCH.backbone),
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=PLAN.search_code(SEARCH.backbone),
    shell:
        "dine --log {log:q} --threads {threads} search-lambda --pairs {input.pairs:q}"
        " --model {input.model:q} {params.priors} --stage2 {params.stage2:q}"
        " --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes} --out {output:q}"


# With a backbone of its own: `own_lambda`.
use rule search_lambda as search_own_lambda with:
    input:
        pairs=FILES.data(SEARCH.dataset).pairs,
        model=FILES.run(SEARCH.dataset, "{searching}", "stage1").model,
        priors=lambda wildcards: PLAN.searched_priors(wildcards.searching),
    output:
        FILES.search_of("{searching}"),
    log:
        FILES.log("search_lambda_{searching}"),
    benchmark:
        FILES.benchmark("search_lambda_{searching}")
    wildcard_constraints:
        searching="|".join(own_searches(CONFIG)) or NOTHING,
    params:
        priors=lambda wildcards, input: options(
            "--prior", CONFIG.searched(wildcards.searching), input.priors
        ),
        settings=lambda wildcards: PLAN.search(wildcards.searching),
        code=lambda wildcards: PLAN.search_code(wildcards.searching),

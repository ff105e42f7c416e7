# Does a prior help, which one, and how sure are we? `snakemake -j2 evidence`; not part of `all`.
# Stage 1, the control and the priors of `all` are trained again with every seed; then the methods
# of the configuration, and all of them are evaluated on objects that nothing else has seen.

TESTED = EVIDENCE.data("{dataset}")
REFINED = EVIDENCE.cell("{dataset}", "{cell_backbone}", "{seed}", "{refined}")


wildcard_constraints:
    cell_backbone=EVERY_BACKBONE,
    seed=r"\d+",
    network="|".join(
        [
            dine_config.STAGE1,
            dine_config.CONTROL,
            *CONFIG.priors_of_stage2,
            *evidence_names(CONFIG, dine_config.Stage2Method),
        ]
    ),
    refined="|".join(evidence_names(CONFIG, dine_config.RefinedMethod)) or NOTHING,
    classical="|".join(evidence_names(CONFIG, dine_config.ClassicalMethod)) or NOTHING,


use rule raw as evidence_raw with:
    output:
        raw=TESTED.raw,
        inventory=TESTED.inventory,
        left_out=TESTED.left_out,
    log:
        FILES.log("evidence", "{dataset}", "raw"),
    benchmark:
        FILES.benchmark("evidence", "{dataset}", "raw")
    params:
        settings=lambda wildcards: PLAN.test_raw(wildcards.dataset),
        signature=lambda wildcards: PLAN.test_signature(wildcards.dataset),
        first=FIRST_TEST_OBJECT,


use rule pairs as evidence_pairs with:
    input:
        raw=TESTED.raw,
    output:
        TESTED.pairs,
    log:
        FILES.log("evidence", "{dataset}", "pairs"),
    benchmark:
        FILES.benchmark("evidence", "{dataset}", "pairs")
    params:
        more="--test-only",
        settings=lambda wildcards: PLAN.test_pairs(wildcards.dataset),


use rule corrupt as evidence_corrupt with:
    input:
        lambda wildcards: PLAN.test_pairs_file(wildcards.dataset),
    output:
        TESTED.variant("{condition}", "{corruption}"),
    log:
        FILES.log("evidence", "{dataset}", "variants", "{condition}_{corruption}"),
    benchmark:
        FILES.benchmark("evidence", "{dataset}", "variants", "{condition}_{corruption}")
    params:
        some=lambda wildcards: options("--at", PLAN.test_levels(wildcards.dataset)),


use rule resample as evidence_resample with:
    input:
        raws=lambda wildcards: PLAN.test_raw_files(wildcards.dataset),
        pairs=lambda wildcards: PLAN.test_pairs_file(wildcards.dataset),
    output:
        TESTED.variant("resampled", 1),
    log:
        FILES.log("evidence", "{dataset}", "variants", "resampled_1"),
    benchmark:
        FILES.benchmark("evidence", "{dataset}", "variants", "resampled_1")
    params:
        some=lambda wildcards: options("--at", PLAN.test_levels(wildcards.dataset)),


# λ of every method of its own, on the dataset and backbone of `lambda_search`.
use rule search_lambda as evidence_lambda with:
    input:
        pairs=FILES.data(SEARCH.dataset).pairs,
        model=FILES.run(SEARCH.dataset, SEARCH.backbone, "stage1").model,
        priors=lambda wildcards: [PLAN.method_searched(wildcards.trained)],
    output:
        EVIDENCE.search("{trained}"),
    log:
        FILES.log("evidence", "lambda", "{trained}"),
    benchmark:
        FILES.benchmark("evidence", "lambda", "{trained}")
    params:
        priors=lambda wildcards, input: options(
            "--prior", [wildcards.trained], input.priors
        ),
        stage2=lambda wildcards: PLAN.method_stage2(wildcards.trained),
        settings=lambda wildcards: PLAN.method_search(wildcards.trained),
        code=lambda wildcards: PLAN.method_code(
            wildcards.trained, "search-lambda", SEARCH.backbone
        ),


use rule stage2_control as stage2_method with:
    input:
        unpack(
            lambda wildcards: PLAN.method_inputs(
                wildcards.trained, wildcards.dataset, wildcards.backbone
            )
        ),
        pairs=rules.pairs.output,
        model=rules.stage1.output.model,
    output:
        **trained(FILES.run("{dataset}", "{backbone}", "{trained}")),
    log:
        FILES.log("{dataset}", "{backbone}", "stage2", "{trained}"),
    benchmark:
        FILES.benchmark("{dataset}", "{backbone}", "stage2", "{trained}")
    params:
        variant=lambda wildcards: wildcards.trained,
        prior=lambda wildcards, input: method_options(wildcards.trained, input),
        settings=lambda wildcards: PLAN.method_stage2(wildcards.trained),
        code=lambda wildcards: PLAN.method_code(
            wildcards.trained, "stage2", wildcards.backbone
        ),


use rule predict as evidence_predict with:
    input:
        model=lambda wildcards: PLAN.model(
            wildcards.dataset,
            wildcards.cell_backbone,
            int(wildcards.seed),
            wildcards.network,
        ),
        pairs=lambda wildcards: PLAN.test_pairs_file(wildcards.dataset),
        variants=lambda wildcards: PLAN.test_variants(wildcards.dataset),
    output:
        EVIDENCE.cell("{dataset}", "{cell_backbone}", "{seed}", "{network}").predictions,
    log:
        FILES.log(
            "evidence",
            "{dataset}",
            "{cell_backbone}",
            "seed{seed}",
            "{network}_predict",
        ),
    benchmark:
        FILES.benchmark(
            "evidence",
            "{dataset}",
            "{cell_backbone}",
            "seed{seed}",
            "{network}_predict",
        )
    params:
        name="{dataset}/{cell_backbone}/seed{seed}/{network}",
        code=lambda wildcards: PLAN.code("predict", wildcards.cell_backbone),


rule evidence_refine:
    input:
        unpack(
            lambda wildcards: PLAN.refined_inputs(
                wildcards.refined,
                wildcards.dataset,
                wildcards.cell_backbone,
                int(wildcards.seed),
            )
        ),
        pairs=lambda wildcards: PLAN.test_pairs_file(wildcards.dataset),
        variants=lambda wildcards: PLAN.test_variants(wildcards.dataset),
    output:
        REFINED.predictions,
    log:
        FILES.log(
            "evidence",
            "{dataset}",
            "{cell_backbone}",
            "seed{seed}",
            "{refined}_refine",
        ),
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("registration"),
    params:
        variants=lambda wildcards, input: options("--variant", input.variants),
        prior=lambda wildcards, input: options(
            "--prior", [path for name, path in input.items() if name == "prior"]
        ),
        settings=lambda wildcards: section(PLAN.method(wildcards.refined)),
        code=lambda wildcards: PLAN.method_code(wildcards.refined, "refine-predictions"),
    shell:
        "dine --log {log:q} --threads {threads} refine-predictions"
        " --predictions {input.predictions:q} --pairs {input.pairs:q} {params.variants}"
        " {params.prior} --settings {params.settings:q} --out {output:q} --name"
        " '{wildcards.dataset}/{wildcards.cell_backbone}/seed{wildcards.seed}/{wildcards.refined}'"


rule evidence_classical:
    input:
        pairs=lambda wildcards: PLAN.test_pairs_file(wildcards.dataset),
        variants=lambda wildcards: PLAN.test_variants(wildcards.dataset),
    output:
        EVIDENCE.cell("{dataset}", NO_BACKBONE, 0, "{classical}").predictions,
    log:
        FILES.log(
            "evidence", "{dataset}", NO_BACKBONE, "seed0", "{classical}_classical"
        ),
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("registration"),
    params:
        variants=lambda wildcards, input: options("--variant", input.variants),
        algorithm=lambda wildcards: PLAN.method(wildcards.classical).algorithm,
        arguments=lambda wildcards: text(PLAN.method(wildcards.classical).arguments),
        code=lambda wildcards: code_digest(
            "classical", PLAN.method(wildcards.classical).algorithm
        ),
    shell:
        "dine --log {log:q} --threads {threads} classical --pairs {input.pairs:q}"
        " {params.variants} --algorithm {params.algorithm:q} --arguments {params.arguments:q}"
        " --name '{wildcards.dataset}/{wildcards.classical}' --out {output:q}"


# One job for all methods of a network and seed, as starting a job takes longer than its share.
rule evidence_evaluate:
    input:
        predictions=lambda wildcards: PLAN.predictions(group(wildcards)),
        pairs=lambda wildcards: PLAN.test_pairs_file(wildcards.dataset),
        variants=lambda wildcards: PLAN.test_variants(wildcards.dataset),
    output:
        EVIDENCE.metrics("{dataset}", "{group}", "{seed}"),
    log:
        FILES.log("evidence", "{dataset}", "{group}", "seed{seed}", "evaluate"),
    wildcard_constraints:
        group=f"{NO_BACKBONE}|{EVERY_BACKBONE}",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("evaluation"),
    params:
        variants=lambda wildcards, input: options("--variant", input.variants),
        runs=lambda wildcards, input: cell_options(group(wildcards), input.predictions),
        code=code_digest("evaluate"),
    shell:
        "dine --log {log:q} evaluate {params.runs} --pairs {input.pairs:q}"
        " {params.variants} --dataset {wildcards.dataset} --backbone {wildcards.group}"
        " --seed {wildcards.seed} --out {output:q}"


# On true displacements of validation pairs, with the first seed.
rule evidence_diagnose:
    input:
        prior=rules.fit_prior.output,
        fields=rules.fields.output,
        pairs=rules.pairs.output,
    output:
        result=EVIDENCE.diagnostics("{dataset}", "{backbone}", "{prior}"),
        samples=EVIDENCE.diagnostics("{dataset}", "{backbone}", "{prior}", "png"),
    log:
        FILES.log("evidence", "diagnostics", "{dataset}", "{backbone}", "{prior}"),
    conda:
        "../envs/dine.yaml"
    resources:
        **request("prior"),
    params:
        seed=CONFIG.seed,
        code=lambda wildcards: PLAN.code("diagnose", priors=[wildcards.prior]),
    shell:
        "dine --log {log:q} diagnose --prior {input.prior:q} --fields {input.fields:q}"
        " --pairs {input.pairs:q} --dataset {wildcards.dataset} --backbone {wildcards.backbone}"
        " --name {wildcards.prior} --seed {params.seed} --out {output.result:q}"


rule evidence_examples:
    input:
        predictions=lambda wildcards: PLAN.predictions(
            PLAN.example_cells(wildcards.dataset)
        ),
        pairs=lambda wildcards: PLAN.test_pairs_file(wildcards.dataset),
        variants=lambda wildcards: PLAN.test_variants(wildcards.dataset),
    output:
        views=EVIDENCE.examples("{dataset}"),
        print=EVIDENCE.examples("{dataset}", "pdf"),
    log:
        FILES.log("evidence", "{dataset}", "examples"),
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        variants=lambda wildcards, input: options("--variant", input.variants),
        runs=lambda wildcards, input: cell_options(
            PLAN.example_cells(wildcards.dataset), input.predictions
        ),
        methods=PLAN.method_texts(),
        code=code_digest("examples"),
    shell:
        "dine --log {log:q} examples {params.runs} --pairs {input.pairs:q} {params.variants}"
        " --methods {params.methods:q} --dataset {wildcards.dataset} --out {output.views:q}"


rule evidence:
    input:
        examples=list(PLAN.examples().values()),
        metrics=PLAN.metrics(),
        searches=PLAN.all_searches(),
        diagnostics=[EVIDENCE.diagnostics(*prior) for prior in PLAN.diagnosed()],
        kept=PLAN.evidence_kept(),
    output:
        report(
            EVIDENCE.report,
            caption="../report/evidence.rst",
            category="Evidence",
        ),
    log:
        FILES.log("evidence", "report"),
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        searches=lambda wildcards, input: options("--search", input.searches),
        diagnostics=lambda wildcards, input: options("--diagnostics", input.diagnostics),
        examples=lambda wildcards, input: options(
            "--example", PLAN.examples(), input.examples, EXAMPLE_TEXTS
        ),
        methods=PLAN.method_texts(),
        settings=PLAN.whole,
        code=code_digest("evidence"),
    shell:
        "dine --log {log:q} evidence {input.metrics:q} {params.searches} {params.diagnostics}"
        " {params.examples}"
        " --methods {params.methods:q} --settings {params.settings:q}"
        ' --out "$(dirname -- {output:q})"'

# Does a prior help, which one, and how sure are we? `snakemake -j2 evidence`; not part of `all`.
# Stage 1, the control and the priors of `all` are trained again with every seed; then the methods
# of the configuration, and all of them are evaluated on objects that nothing else has seen.

EVIDENCE = RESULTS / "evidence"
EVIDENCE_LOGS = LOGS / "evidence"
EVIDENCE_BENCHMARKS = BENCHMARKS / "evidence"
# Other numbers than those of any dataset or of the pretraining.
FIRST_TEST_OBJECT = 2_000_000


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


rule evidence_raw:
    output:
        EVIDENCE / "{dataset}" / "raw.json",
    log:
        EVIDENCE_LOGS / "{dataset}" / "raw.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=evidence_raw_settings,
        signature=evidence_raw_signature,
        first=FIRST_TEST_OBJECT,
        seed=CONFIG.seed,
        code=code_digest("raw"),
    shell:
        "dine --log {log:q} raw --settings {params.settings:q} --first-object {params.first}"
        ' --seed {params.seed} --out "$(dirname -- {output:q})"'


rule evidence_pairs:
    input:
        rules.evidence_raw.output,
    output:
        EVIDENCE / "{dataset}" / "pairs.h5",
    log:
        EVIDENCE_LOGS / "{dataset}" / "pairs.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=evidence_pair_settings,
        seed=CONFIG.seed,
        code=code_digest("pairs"),
    shell:
        "dine --log {log:q} pairs --raw {input:q} --settings {params.settings:q} --test-only"
        " --seed {params.seed} --out {output:q}"


rule evidence_corrupt:
    input:
        evidence_pairs_file,
    output:
        EVIDENCE / "{dataset}" / "variants" / "{condition}_{corruption}.h5",
    log:
        EVIDENCE_LOGS / "{dataset}" / "variants" / "{condition}_{corruption}.log",
    wildcard_constraints:
        condition="noise|outliers",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        levels=evidence_levels,
        seed=CONFIG.seed,
        code=code_digest("corrupt"),
    shell:
        "dine --log {log:q} corrupt --pairs {input:q} --condition {wildcards.condition}"
        " --level {wildcards.corruption} {params.levels} --seed {params.seed} --out {output:q}"


rule evidence_resample:
    input:
        pairs=evidence_pairs_file,
        raws=evidence_raw_files,
    output:
        EVIDENCE / "{dataset}" / "variants" / "resampled_1.h5",
    log:
        EVIDENCE_LOGS / "{dataset}" / "variants" / "resampled_1.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        raws=lambda wildcards, input: options("--raw", input.raws),
        levels=evidence_levels,
        seed=CONFIG.seed,
        code=code_digest("resample"),
    shell:
        "dine --log {log:q} resample {params.raws} --pairs {input.pairs:q}"
        " {params.levels} --seed {params.seed} --out {output:q}"


# λ of every method of its own, on the dataset and backbone of `lambda_search`.
rule evidence_lambda:
    input:
        pairs=FILES.dataset(SEARCH.dataset, "pairs.h5"),
        model=FILES.run(SEARCH.dataset, SEARCH.backbone, "stage1", "model.safetensors"),
        prior=searched_prior,
    output:
        EVIDENCE / "lambda" / "{trained}.json",
    log:
        EVIDENCE_LOGS / "lambda" / "{trained}.log",
    benchmark:
        EVIDENCE_BENCHMARKS / "lambda" / "{trained}.tsv"
    priority: 40
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        stage2=method_stage2,
        settings=evidence_search,
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=searched_code,
    shell:
        "dine --log {log:q} --threads {threads} search-lambda --pairs {input.pairs:q}"
        " --model {input.model:q} --prior {wildcards.trained} {input.prior:q}"
        " --stage2 {params.stage2:q} --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes} --out {output:q}"


rule stage2_method:
    input:
        unpack(method_inputs),
        pairs=rules.pairs.output,
        model=rules.stage1.output.model,
    output:
        **stage2_outputs("{trained}"),
    log:
        LOGS / "{dataset}" / "{backbone}" / "stage2" / "{trained}.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "{backbone}" / "stage2" / "{trained}.tsv"
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        prior=method_prior_options,
        settings=method_stage2,
        seed=training_seed,
        compute=COMPUTE,
        code=method_code,
    shell:
        "dine --log {log:q} --threads {threads} stage2 --pairs {input.pairs:q}"
        " --model {input.model:q} --variant {wildcards.trained} {params.prior}"
        " --settings {params.settings:q} --seed {params.seed}"
        " {params.compute} --processes {resources.processes}"
        " --name '{wildcards.dataset}/{wildcards.backbone}/{wildcards.trained}'"
        ' --out "$(dirname -- {output.model:q})"'


rule evidence_predict:
    input:
        model=evidence_model,
        pairs=evidence_pairs_file,
        variants=evidence_variants,
    output:
        EVIDENCE
        / "{dataset}"
        / "{cell_backbone}"
        / "seed{seed}"
        / "{network}"
        / "predictions.h5",
    log:
        EVIDENCE_LOGS
        / "{dataset}"
        / "{cell_backbone}"
        / "seed{seed}"
        / "{network}_predict.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        variants=variant_options,
        batch=CONFIG.evaluation.batch_size,
        compute=COMPUTE,
        code=lambda wildcards: code_of("predict", wildcards.cell_backbone),
    shell:
        "dine --log {log:q} --threads {threads} predict --model {input.model:q}"
        " --pairs {input.pairs:q} {params.variants} --batch-size {params.batch}"
        " {params.compute} --out {output:q} --name"
        " '{wildcards.dataset}/{wildcards.cell_backbone}/seed{wildcards.seed}/{wildcards.network}'"


rule evidence_refine:
    input:
        unpack(refined_inputs),
        pairs=evidence_pairs_file,
        variants=evidence_variants,
    output:
        EVIDENCE
        / "{dataset}"
        / "{cell_backbone}"
        / "seed{seed}"
        / "{refined}"
        / "predictions.h5",
    log:
        EVIDENCE_LOGS
        / "{dataset}"
        / "{cell_backbone}"
        / "seed{seed}"
        / "{refined}_refine.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("registration"),
    params:
        variants=variant_options,
        prior=refined_prior_options,
        settings=lambda wildcards: section(CONFIG.evidence.methods[wildcards.refined]),
        code=refined_code,
    shell:
        "dine --log {log:q} --threads {threads} refine-predictions"
        " --predictions {input.predictions:q} --pairs {input.pairs:q} {params.variants}"
        " {params.prior} --settings {params.settings:q} --out {output:q} --name"
        " '{wildcards.dataset}/{wildcards.cell_backbone}/seed{wildcards.seed}/{wildcards.refined}'"


rule evidence_classical:
    input:
        pairs=evidence_pairs_file,
        variants=evidence_variants,
    output:
        EVIDENCE / "{dataset}" / "none" / "seed0" / "{classical}" / "predictions.h5",
    log:
        EVIDENCE_LOGS / "{dataset}" / "none" / "seed0" / "{classical}_classical.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("registration"),
    params:
        variants=variant_options,
        algorithm=lambda wildcards: CONFIG.evidence.methods[
            wildcards.classical
        ].algorithm,
        arguments=lambda wildcards: json.dumps(
            CONFIG.evidence.methods[wildcards.classical].arguments, sort_keys=True
        ),
        code=lambda wildcards: code_digest(
            "classical", CONFIG.evidence.methods[wildcards.classical].algorithm
        ),
    shell:
        "dine --log {log:q} --threads {threads} classical --pairs {input.pairs:q}"
        " {params.variants} --algorithm {params.algorithm:q} --arguments {params.arguments:q}"
        " --name '{wildcards.dataset}/{wildcards.classical}' --out {output:q}"


# One job for all methods of a network and seed, as starting a job takes longer than its share.
rule evidence_evaluate:
    input:
        predictions=lambda wildcards: cell_predictions(group_cells(wildcards)),
        pairs=evidence_pairs_file,
        variants=evidence_variants,
    output:
        EVIDENCE / "{dataset}" / "{group}" / "seed{seed}" / "metrics.csv",
    log:
        EVIDENCE_LOGS / "{dataset}" / "{group}" / "seed{seed}" / "evaluate.log",
    wildcard_constraints:
        group=f"none|{EVERY_BACKBONE}",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("evaluation"),
    params:
        variants=variant_options,
        runs=lambda wildcards, input: cell_options(
            group_cells(wildcards), input.predictions
        ),
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
        result=EVIDENCE / "diagnostics" / "{dataset}" / "{backbone}" / "{prior}.json",
        samples=EVIDENCE / "diagnostics" / "{dataset}" / "{backbone}" / "{prior}.png",
    log:
        EVIDENCE_LOGS / "diagnostics" / "{dataset}" / "{backbone}" / "{prior}.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("prior"),
    params:
        seed=CONFIG.seed,
        code=lambda wildcards: code_of("diagnose", priors=[wildcards.prior]),
    shell:
        "dine --log {log:q} diagnose --prior {input.prior:q} --fields {input.fields:q}"
        " --pairs {input.pairs:q} --dataset {wildcards.dataset} --backbone {wildcards.backbone}"
        " --name {wildcards.prior} --seed {params.seed} --out {output.result:q}"


rule evidence_examples:
    input:
        predictions=lambda wildcards: cell_predictions(example_cells(wildcards.dataset)),
        pairs=evidence_pairs_file,
        variants=evidence_variants,
    output:
        views=EVIDENCE / "{dataset}" / "examples.png",
        print=EVIDENCE / "{dataset}" / "examples.pdf",
    log:
        EVIDENCE_LOGS / "{dataset}" / "examples.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        variants=variant_options,
        runs=lambda wildcards, input: cell_options(
            example_cells(wildcards.dataset), input.predictions
        ),
        methods=evidence_method_texts(),
        code=code_digest("examples"),
    shell:
        "dine --log {log:q} examples {params.runs} --pairs {input.pairs:q} {params.variants}"
        " --methods {params.methods:q} --dataset {wildcards.dataset} --out {output.views:q}"


rule evidence:
    input:
        examples=evidence_examples(),
        metrics=evidence_metrics(),
        searches=evidence_searches(),
        diagnostics=evidence_diagnostics(),
        kept=evidence_kept(),
    output:
        report(
            EVIDENCE / "report.html",
            caption="../report/evidence.rst",
            category="Evidence",
        ),
    log:
        EVIDENCE_LOGS / "report.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        searches=lambda wildcards, input: options("--search", input.searches),
        diagnostics=lambda wildcards, input: options("--diagnostics", input.diagnostics),
        examples=evidence_example_options,
        methods=evidence_method_texts(),
        settings=whole_config(),
        code=code_digest("evidence"),
    shell:
        "dine --log {log:q} evidence {input.metrics:q} {params.searches} {params.diagnostics}"
        " {params.examples}"
        " --methods {params.methods:q} --settings {params.settings:q}"
        ' --out "$(dirname -- {output:q})"'

# Weights of our own to start Stage 1 from; `snakemake -j2 pretrained`. Not part of `all`.

SHAPES = PLAN.pretraining_shapes
SHAPE = FILES.pretraining_data("{shape}")
PRETRAINED = FILES.pretrained("{backbone}")
SHAPES_DATA = [FILES.pretraining_data(shape) for shape in SHAPES]


use rule raw as pretraining_raw with:
    output:
        raw=SHAPE.raw,
        inventory=SHAPE.inventory,
        left_out=SHAPE.left_out,
    log:
        FILES.log("pretraining", "{shape}_raw"),
    benchmark:
        FILES.benchmark("pretraining", "{shape}_raw")
    params:
        settings=lambda wildcards: PLAN.pretraining_raw(wildcards.shape),
        signature="",
        first=FIRST_PRETRAINING_OBJECT,


use rule pairs as pretraining_pairs with:
    input:
        raw=SHAPE.raw,
    output:
        SHAPE.pairs,
    log:
        FILES.log("pretraining", "{shape}_pairs"),
    benchmark:
        FILES.benchmark("pretraining", "{shape}_pairs")
    params:
        more="",
        settings=PLAN.pretraining_pairs,


# Two scans share no points: half of what is trained on has targets of other points, too.
use rule resample as pretraining_targets with:
    input:
        raws=[SHAPE.raw],
        pairs=SHAPE.pairs,
    output:
        SHAPE.resampled,
    log:
        FILES.log("pretraining", "{shape}_targets"),
    benchmark:
        FILES.benchmark("pretraining", "{shape}_targets")
    params:
        some="",


rule pretrain:
    input:
        pairs=[data.pairs for data in SHAPES_DATA],
        targets=[data.resampled for data in SHAPES_DATA],
    output:
        **trained(PRETRAINED),
    log:
        FILES.log("pretraining", "{backbone}"),
    benchmark:
        FILES.benchmark("pretraining", "{backbone}")
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        pairs=lambda wildcards, input: options("--pairs", input.pairs),
        targets=lambda wildcards, input: options("--targets", input.targets),
        backbone=lambda wildcards: PLAN.network(wildcards.backbone),
        settings=section(CONFIG.pretraining),
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=lambda wildcards: PLAN.code(
            "pretrain", wildcards.backbone, data_term=CONFIG.pretraining.data_term
        ),
    shell:
        "dine --log {log:q} --threads {threads} pretrain {params.pairs}"
        " {params.targets}"
        " --backbone {params.backbone:q} --settings {params.settings:q} --seed {params.seed}"
        ' {params.compute} --processes {resources.processes} --out "$(dirname -- {output.model:q})"'


# What `dine register` needs beside the weights: a prior, and what uncertainty means.


use rule fields as pretraining_fields with:
    input:
        model=PRETRAINED.model,
        pairs=SHAPE.pairs,
        targets=SHAPE.resampled,
    output:
        FILES.pretraining_fields("{backbone}", "{shape}"),
    log:
        FILES.log("pretraining", "{backbone}_fields_{shape}"),
    benchmark:
        FILES.benchmark("pretraining", "{backbone}_fields_{shape}")
    params:
        targets=lambda wildcards, input: options("--targets", [input.targets]),
        name="pretraining/{backbone}/{shape}",


use rule fit_prior as pretraining_prior with:
    input:
        [FILES.pretraining_fields("{backbone}", shape) for shape in SHAPES],
    output:
        PRETRAINED.prior,
    log:
        FILES.log("pretraining", "{backbone}_prior"),
    benchmark:
        FILES.benchmark("pretraining", "{backbone}_prior")
    params:
        settings=section(dine_config.PriorConfig(kind="pca")),
        seed=CONFIG.seed,
        code=code_digest("fit-prior", "pca"),


use rule calibrate as pretraining_calibration with:
    input:
        model=PRETRAINED.model,
        pairs=[data.pairs for data in SHAPES_DATA],
        targets=[data.resampled for data in SHAPES_DATA],
        raws=[data.raw for data in SHAPES_DATA],
        priors=[PRETRAINED.prior],
    output:
        calibration=PRETRAINED.calibration,
        plot=PRETRAINED.calibration_plot,
    log:
        FILES.log("pretraining", "{backbone}_calibration"),
    params:
        code=lambda wildcards: code_digest(
            "calibrate", PLAN.backbone(wildcards.backbone).kind, "pca"
        ),


# All of it, so that a deleted file is made again.
rule pretrained:
    input:
        PLAN.pretrained_kept(),

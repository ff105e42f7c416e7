# Weights of our own to start Stage 1 from; `snakemake -j2 pretrained`. Not part of `all`.

PRETRAINING = RESULTS / "pretraining"
# Far beyond the numbers that any dataset uses, so that no object is trained on and tested on.
FIRST_OBJECT = 1_000_000
# Somewhat harder than the default datasets.
AMPLITUDE = 0.15
LEVELS = {
    "primitives": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8],
    "tissue": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7],
}


rule pretraining_raw:
    output:
        PRETRAINING / "{shape}" / "raw.json",
    log:
        LOGS / "pretraining" / "{shape}_raw.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=lambda wildcards: json.dumps(
            {
                "recipe": {
                    "shape": wildcards.shape,
                    "objects": CONFIG.pretraining.objects // 2,
                    "levels": LEVELS[wildcards.shape],
                    "amplitude": AMPLITUDE,
                }
            },
            sort_keys=True,
        ),
        first=FIRST_OBJECT,
        seed=CONFIG.seed,
        code=code_digest("raw"),
    shell:
        "dine --log {log:q} raw --settings {params.settings:q} --first-object {params.first}"
        ' --seed {params.seed} --out "$(dirname -- {output:q})"'


rule pretraining_pairs:
    input:
        rules.pretraining_raw.output,
    output:
        PRETRAINING / "{shape}" / "pairs.h5",
    log:
        LOGS / "pretraining" / "{shape}_pairs.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=lambda wildcards: json.dumps(
            {
                "convention": "sphere",  # one for both shapes, as one prior is fitted to both
                "split": {"train": 0.9, "val": 0.05, "test": 0.05},
            },
            sort_keys=True,
        ),
        seed=CONFIG.seed,
        code=code_digest("pairs"),
    shell:
        "dine --log {log:q} pairs --raw {input:q} --settings {params.settings:q}"
        " --seed {params.seed} --out {output:q}"


# Two scans share no points: half of what is trained on has targets of other points, too.
rule pretraining_targets:
    input:
        raw=rules.pretraining_raw.output,
        pairs=rules.pretraining_pairs.output,
    output:
        PRETRAINING / "{shape}" / "resampled.h5",
    log:
        LOGS / "pretraining" / "{shape}_targets.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        seed=CONFIG.seed,
        code=code_digest("resample"),
    shell:
        "dine --log {log:q} resample --raw {input.raw:q} --pairs {input.pairs:q}"
        " --seed {params.seed} --out {output:q}"


rule pretrain:
    input:
        pairs=expand(PRETRAINING / "{shape}" / "pairs.h5", shape=LEVELS),
        targets=expand(PRETRAINING / "{shape}" / "resampled.h5", shape=LEVELS),
    output:
        model=PRETRAINING / "{backbone}" / "model.safetensors",
        history=PRETRAINING / "{backbone}" / "history.csv",
        record=PRETRAINING / "{backbone}" / "run.json",
    log:
        LOGS / "pretraining" / "{backbone}.log",
    benchmark:
        BENCHMARKS / "pretraining" / "{backbone}.tsv"
    conda:
        "../envs/dine.yaml"
    threads: THREADS * PROCESSES
    resources:
        **request("training"),
    params:
        pairs=lambda wildcards, input: options("--pairs", input.pairs),
        targets=lambda wildcards, input: options("--targets", input.targets),
        backbone=backbone_settings,
        settings=section(CONFIG.pretraining),
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=lambda wildcards: code_of(
            "pretrain", wildcards.backbone, data_term=CONFIG.pretraining.data_term
        ),
    shell:
        "dine --log {log:q} --threads {threads} pretrain {params.pairs}"
        " {params.targets}"
        " --backbone {params.backbone:q} --settings {params.settings:q} --seed {params.seed}"
        ' {params.compute} --processes {resources.processes} --out "$(dirname -- {output.model:q})"'


# What `dine register` needs beside the weights: a prior, and what uncertainty means.


rule pretraining_fields:
    input:
        model=rules.pretrain.output.model,
        pairs=rules.pretraining_pairs.output,
        targets=rules.pretraining_targets.output,
    output:
        PRETRAINING / "{backbone}" / "fields_{shape}.h5",
    log:
        LOGS / "pretraining" / "{backbone}_fields_{shape}.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        compute=COMPUTE,
        code=lambda wildcards: code_of("fields", wildcards.backbone),
    shell:
        "dine --log {log:q} --threads {threads} fields --model {input.model:q}"
        " --pairs {input.pairs:q} --targets {input.targets:q} {params.compute}"
        " --name 'pretraining/{wildcards.backbone}/{wildcards.shape}' --out {output:q}"


rule pretraining_prior:
    input:
        expand(
            PRETRAINING / "{backbone}" / "fields_{shape}.h5",
            shape=LEVELS,
            allow_missing=True,
        ),
    output:
        PRETRAINING / "{backbone}" / "prior.safetensors",
    log:
        LOGS / "pretraining" / "{backbone}_prior.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prior"),
    params:
        fields=lambda wildcards, input: options("--fields", input),
        settings=json.dumps({"kind": "pca"}),
        seed=CONFIG.seed,
        code=code_digest("fit-prior", "pca"),
    shell:
        "dine --log {log:q} --threads {threads} fit-prior {params.fields}"
        " --settings {params.settings:q} --seed {params.seed} --out {output:q}"


rule pretraining_calibration:
    input:
        model=rules.pretrain.output.model,
        pairs=expand(PRETRAINING / "{shape}" / "pairs.h5", shape=LEVELS),
        targets=expand(PRETRAINING / "{shape}" / "resampled.h5", shape=LEVELS),
        prior=rules.pretraining_prior.output,
    output:
        calibration=PRETRAINING / "{backbone}" / "calibration.json",
        plot=PRETRAINING / "{backbone}" / "calibration.png",
    log:
        LOGS / "pretraining" / "{backbone}_calibration.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        pairs=lambda wildcards, input: options("--pairs", input.pairs),
        targets=lambda wildcards, input: options("--targets", input.targets),
        device=CONFIG.device,
        code=lambda wildcards: code_digest(
            "calibrate", backbone_config(wildcards).kind, "pca"
        ),
    shell:
        "dine --log {log:q} --threads {threads} calibrate --model {input.model:q}"
        " {params.pairs} {params.targets} --prior {input.prior:q} --device {params.device}"
        " --out {output.calibration:q}"


# All of it, so that a deleted file is made again.
rule pretrained:
    input:
        expand(
            PRETRAINING / "{shape}" / "{file}",
            shape=LEVELS,
            file=["raw.json", "pairs.h5", "resampled.h5"],
        ),
        expand(
            PRETRAINING / "{backbone}" / "{file}",
            backbone=CONFIG.backbones,
            file=["model.safetensors", "prior.safetensors", "calibration.json"],
        ),
        expand(
            PRETRAINING / "{backbone}" / "fields_{shape}.h5",
            backbone=CONFIG.backbones,
            shape=LEVELS,
        ),

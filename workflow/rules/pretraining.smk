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
        ' --seed {params.seed} --out "$(dirname {output:q})"'


rule pretraining_pairs:
    input:
        rules.pretraining_raw.output,
    output:
        PRETRAINING / "{shape}" / "pairs.h5",
    log:
        LOGS / "pretraining" / "{shape}_pairs.log",
    conda:
        "../envs/dine.yaml"
    params:
        settings=lambda wildcards: json.dumps(
            {
                "convention": "none",  # no prior is fitted to these fields
                "split": {"train": 0.9, "val": 0.05, "test": 0.05},
            },
            sort_keys=True,
        ),
        seed=CONFIG.seed,
        code=code_digest("pairs"),
    shell:
        "dine --log {log:q} pairs --raw {input:q} --settings {params.settings:q}"
        " --seed {params.seed} --out {output:q}"


rule pretrain:
    input:
        expand(rules.pretraining_pairs.output, shape=LEVELS),
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
        gpu=GPUS * PROCESSES,
        processes=PROCESSES,
    params:
        pairs=lambda wildcards, input: options("--pairs", input),
        backbone=backbone_settings,
        settings=section(CONFIG.pretraining),
        seed=CONFIG.seed,
        compute=COMPUTE,
        code=code_digest("model", "training"),
    shell:
        "dine --log {log:q} --threads {threads} pretrain {params.pairs}"
        " --backbone {params.backbone:q} --settings {params.settings:q} --seed {params.seed}"
        ' {params.compute} --processes {resources.processes} --out "$(dirname {output.model:q})"'


rule pretrained:
    input:
        expand(rules.pretrain.output, backbone=CONFIG.backbones),

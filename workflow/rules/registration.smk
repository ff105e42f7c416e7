# What `dine register` needs beside a trained model; `snakemake -j2 calibrations`. Not part of `all`.


def calibrating_prior(wildcards):
    """The backbone's first PCA prior, if any: what the trust score measures fields with."""
    return [
        FILES.prior(wildcards.dataset, wildcards.backbone, prior)
        for prior in pca_priors(CONFIG, wildcards.backbone)[:1]
    ]


rule calibrate:
    input:
        model=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "model.safetensors",
        pairs=rules.pairs.output,
        prior=calibrating_prior,
    output:
        RESULTS / "{dataset}" / "{backbone}" / "{run}" / "calibration.json",
        RESULTS / "{dataset}" / "{backbone}" / "{run}" / "calibration.png",
    log:
        LOGS / "{dataset}" / "{backbone}" / "{run}" / "calibrate.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        gpu=GPUS,
    params:
        prior=lambda wildcards, input: options("--prior", input.prior),
        device=CONFIG.device,
        code=code_digest("model", "priors", "calibration"),
    shell:
        "dine --log {log:q} --threads {threads} calibrate --model {input.model:q}"
        " --pairs {input.pairs:q} {params.prior} --device {params.device}"
        " --out {output[0]:q}"


rule calibrations:
    input:
        [FILES.run(*run, "calibration.json") for run in RUNS],

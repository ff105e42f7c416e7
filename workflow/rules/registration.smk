# What `dine register` needs beside a trained model; `snakemake -j2 calibrations`. Not part of `all`.


rule calibrate:
    input:
        model=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "model.safetensors",
        pairs=rules.pairs.output,
        prior=calibrating_prior,
    output:
        calibration=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "calibration.json",
        plot=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "calibration.png",
    log:
        LOGS / "{dataset}" / "{backbone}" / "{run}" / "calibrate.log",
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        prior=lambda wildcards, input: options("--prior", input.prior),
        device=CONFIG.device,
        code=code_digest("model", "priors", "calibration"),
    shell:
        "dine --log {log:q} --threads {threads} calibrate --model {input.model:q}"
        " --pairs {input.pairs:q} {params.prior} --device {params.device}"
        " --out {output.calibration:q}"


rule calibrations:
    input:
        [FILES.run(*run, "calibration.json") for run in RUNS],

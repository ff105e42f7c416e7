# What `dine register` needs beside a trained model; `snakemake -j2 calibrations`. Not part of `all`.


# Two scans share no points, so expected errors are learned where targets share none either.
rule calibration_targets:
    input:
        unpack(raw_files),
        pairs=rules.pairs.output,
    output:
        RESULTS / "{dataset}" / "resampled.h5",
    log:
        LOGS / "{dataset}" / "resampled.log",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        raws=raw_options,
        seed=CONFIG.seed,
        code=code_digest("resample"),
    shell:
        "dine --log {log:q} resample {params.raws} --pairs {input.pairs:q}"
        " --seed {params.seed} --out {output:q}"


rule calibrate:
    input:
        model=RESULTS / "{dataset}" / "{backbone}" / "{run}" / "model.safetensors",
        pairs=rules.pairs.output,
        targets=rules.calibration_targets.output,
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
        code=lambda wildcards: code_of(
            "calibrate", wildcards.backbone, priors=calibrating_priors(wildcards)
        ),
    shell:
        "dine --log {log:q} --threads {threads} calibrate --model {input.model:q}"
        " --pairs {input.pairs:q} --targets {input.targets:q} {params.prior} --device {params.device}"
        " --out {output.calibration:q}"


# With what it makes on its way, so that a deleted file is made again.
rule calibrations:
    input:
        [
            FILES.run(*run, name)
            for run in RUNS
            for name in ("model.safetensors", "calibration.json")
        ],
        priors_from("pairs.h5", "resampled.h5"),

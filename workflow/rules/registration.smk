# What `dine register` needs beside a trained model; `snakemake -j2 calibrations`. Not part of `all`.


# Two scans share no points, so expected errors are learned where targets share none either.
use rule resample as calibration_targets with:
    output:
        DATA.resampled,
    log:
        FILES.log("{dataset}", "resampled"),
    benchmark:
        FILES.benchmark("{dataset}", "resampled")
    params:
        some="",


rule calibrate:
    input:
        model=NETWORK.model,
        pairs=[DATA.pairs],
        targets=[DATA.resampled],
        raws=lambda wildcards: [*PLAN.raw_files(wildcards.dataset).values()],
        priors=lambda wildcards: PLAN.calibrating_files(
            wildcards.dataset, wildcards.backbone
        ),
    output:
        calibration=NETWORK.calibration,
        plot=NETWORK.calibration_plot,
    log:
        FILES.log("{dataset}", "{backbone}", "{run}", "calibrate"),
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("prediction"),
    params:
        data=lambda wildcards, input: calibration_options(input),
        device=CONFIG.device,
        code=lambda wildcards: PLAN.code(
            "calibrate",
            wildcards.backbone,
            priors=PLAN.calibrating(wildcards.backbone),
        ),
    shell:
        "dine --log {log:q} --threads {threads} calibrate --model {input.model:q}"
        " {params.data} --device {params.device} --out {output.calibration:q}"


# With what it makes on its way, so that a deleted file is made again.
rule calibrations:
    input:
        PLAN.calibrations_kept(),

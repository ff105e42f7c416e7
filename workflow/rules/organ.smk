# What is a prior of one organ worth where a scan shows a part of it? `snakemake -j2 organ`; not part
# of `all`. Simulations, a prior of them, deformations by other mechanics, and registrations of these.

TRIAL = FILES.trial("{template}")


wildcard_constraints:
    template="|".join(PLAN.organ_templates),
    how="about|patch",
    about="|".join(CONFIG.organ.questions),


rule organ_template:
    output:
        template=TRIAL.template,
        held=[TRIAL.held("about"), TRIAL.held("patch")],
    log:
        FILES.log("organ_trial", "{template}", "template"),
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        mesh=lambda wildcards: PLAN.organ_templates[wildcards.template],
        signature=lambda wildcards: PLAN.organ_signature(wildcards.template),
        code=code_digest("organ-template"),
    shell:
        "dine --log {log:q} organ-template {params.mesh:q}"
        ' --out "$(dirname -- {output.template:q})"'


rule organ_truth:
    input:
        TRIAL.template,
    output:
        TRIAL.truth,
    log:
        FILES.log("organ_trial", "{template}", "truth"),
    benchmark:
        FILES.benchmark("organ_trial", "{template}", "truth")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=PLAN.organ_truth,
        seed=CONFIG.seed,
        code=code_digest("organ-truth"),
    shell:
        "dine --log {log:q} organ-truth {input:q} --settings {params.settings:q}"
        " --seed {params.seed} --out {output:q}"


rule organ_fields:
    input:
        template=TRIAL.template,
        held=TRIAL.held("{how}"),
    output:
        TRIAL.fields("{how}"),
    log:
        FILES.log("organ_trial", "{template}", "fields_{how}"),
    benchmark:
        FILES.benchmark("organ_trial", "{template}", "fields_{how}")
    conda:
        "../envs/dine.yaml"
    threads: THREADS
    resources:
        **request("data"),
    params:
        settings=lambda wildcards: PLAN.organ_simulation(wildcards.how),
        seed=CONFIG.seed,
        code=code_digest("simulate"),
    shell:
        "dine --log {log:q} --threads {threads} simulate {input.template:q} -o {output:q}"
        " --fixed {input.held:q} --settings {params.settings:q} --seed {params.seed}"
        " --workers {threads}"


rule organ_prior:
    input:
        template=TRIAL.template,
        fields=rules.organ_fields.output,
    output:
        TRIAL.prior("{how}"),
    log:
        FILES.log("organ_trial", "{template}", "prior_{how}"),
    benchmark:
        FILES.benchmark("organ_trial", "{template}", "prior_{how}")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("prior"),
    params:
        settings=section(CONFIG.organ.learning),
        seed=CONFIG.seed,
        code=code_digest("learn"),
    shell:
        "dine --log {log:q} learn {input.template:q} {input.fields:q} -o {output:q}"
        " --settings {params.settings:q} --seed {params.seed}"


rule organ_trial:
    input:
        truth=TRIAL.truth,
        held=TRIAL.held("about"),
        prior=TRIAL.prior("about"),
        one_patch=TRIAL.prior("patch"),
    output:
        TRIAL.measured("{about}"),
    log:
        FILES.log("organ_trial", "{template}", "{about}"),
    benchmark:
        FILES.benchmark("organ_trial", "{template}", "{about}")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("registration"),
    params:
        settings=lambda wildcards: PLAN.organ_trial(wildcards.about),
        code=code_digest("organ-trial", "bcpd"),
    shell:
        "dine --log {log:q} organ-trial --truth {input.truth:q} --held {input.held:q}"
        " --prior {input.prior:q} --one-patch {input.one_patch:q} --about {wildcards.about}"
        " --settings {params.settings:q} --out {output:q}"


rule organ:
    input:
        measured=[
            FILES.trial(template).measured(about)
            for template, about in PLAN.organ_measured
        ],
        kept=PLAN.organ_kept(),
    output:
        all=FILES.trial_tables,
    log:
        FILES.log("organ_trial", "tables"),
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        measured=lambda wildcards, input: options(
            "--measured",
            [template for template, _ in PLAN.organ_measured],
            input.measured,
        ),
        code=code_digest("organ-tables"),
    shell:
        "dine --log {log:q} organ-tables {params.measured}"
        ' --out "$(dirname -- {output.all:q})"'

# Tables, figures, the report, and one small table for each prior on its own.

METRICS = [run.metrics for run in RUNS]


rule tables:
    input:
        METRICS,
    output:
        all=FILES.table("all", "md"),
        tables=[
            report(
                FILES.table(table, "csv"),
                caption="../report/table.rst",
                category="Tables",
                labels={"table": table},
            )
            for table in TABLES
        ],
        others=[
            FILES.table(table, suffix) for table in TABLES for suffix in ("md", "tex")
        ],
    log:
        FILES.log("tables"),
    benchmark:
        FILES.benchmark("tables")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        spread=CONFIG.evaluation.training_spread,
        spread_outliers=CONFIG.evaluation.training_spread_outliers,
        code=code_digest("tables"),
    shell:
        "dine --log {log:q} tables {input:q} --spread {params.spread}"
        " --spread-outliers {params.spread_outliers}"
        ' --out "$(dirname -- {output.all:q})"'


rule figures:
    input:
        METRICS,
        [[run.predictions, run.point_errors, run.history] for run in RUNS],
        [FILES.data(dataset).pairs for dataset in CONFIG.datasets],
        [
            FILES.prior(dataset, backbone, prior)
            for dataset in CONFIG.datasets
            for backbone in CONFIG.backbones_of(dataset)
            for prior in pca_priors(CONFIG, backbone)
        ],
        PLAN.searches,
    output:
        figures=[
            report(
                FILES.figure(figure, "png"),
                caption="../report/figure.rst",
                category="Figures",
                labels={"figure": figure},
            )
            for figure in FIGURES
        ],
        pdf=[FILES.figure(figure, "pdf") for figure in FIGURES],
    log:
        FILES.log("figures"),
    benchmark:
        FILES.benchmark("figures")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        settings=PLAN.drawn,
        code=code_digest("figures"),
    shell:
        'drawn="$(dirname -- {output.figures[0]:q})";'
        ' dine --log {log:q} figures --results "$(dirname -- "$drawn")"'
        ' --settings {params.settings:q} --out "$drawn"'


rule resolved_config:
    output:
        FILES.config,
    log:
        FILES.log("config"),
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        config=section(CONFIG),
    shell:
        "dine --log {log:q} config write {params.config:q} --out {output:q}"


rule html:
    input:
        METRICS,
        [run.record for run in RUNS],
        [
            [data.agreement, data.inventory, data.left_out]
            for data in map(FILES.data, CONFIG.datasets)
        ],
        rules.tables.output,
        rules.figures.output,
        rules.resolved_config.output,
        PLAN.searches,
    output:
        report(FILES.report, caption="../report/report.rst", category="Report"),
    log:
        FILES.log("html"),
    benchmark:
        FILES.benchmark("html")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        settings=PLAN.whole,
        code=code_digest("report"),
    shell:
        'dine --log {log:q} report --results "$(dirname -- {output:q})"'
        " --settings {params.settings:q} --out {output:q}"


# One target for each prior: `prior_pca`, `prior_flow`, … compare it with Stage 1 and the control.
for PRIOR in CONFIG.priors:

    rule:
        name:
            f"prior_{PRIOR}"
        input:
            [
                FILES.run(dataset, backbone, method).metrics
                for dataset in CONFIG.datasets
                for backbone in CONFIG.backbones_of(dataset)
                if PRIOR in CONFIG.backbones[backbone].priors
                for method in (dine_config.STAGE1, dine_config.CONTROL, PRIOR)
            ],
        output:
            FILES.ablation(PRIOR),
        log:
            FILES.log("ablation", PRIOR),
        benchmark:
            FILES.benchmark("ablation", PRIOR)
        conda:
            "../envs/dine.yaml"
        resources:
            **request("reporting"),
        params:
            spread=CONFIG.evaluation.training_spread,
            spread_outliers=CONFIG.evaluation.training_spread_outliers,
            code=code_digest("tables"),
        shell:
            "dine --log {log:q} tables {input:q} --spread {params.spread}"
            " --spread-outliers {params.spread_outliers}"
            ' --out "$(dirname -- {output:q})"'


# Handles for parts of the work.
rule data:
    input:
        [FILES.data(dataset).agreement for dataset in CONFIG.datasets],
        [PLAN.variants(dataset) for dataset in CONFIG.datasets],


rule train:
    input:
        [run.model for run in RUNS],

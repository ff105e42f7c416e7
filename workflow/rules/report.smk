# Tables, figures, the report, and one small table for each prior on its own.

METRICS = [FILES.run(*run, "metrics.csv") for run in RUNS]


rule tables:
    input:
        METRICS,
    output:
        all=RESULTS / "tables" / "all.md",
        tables=[
            report(
                RESULTS / "tables" / f"{table}.csv",
                caption="../report/table.rst",
                category="Tables",
                labels={"table": table},
            )
            for table in TABLES
        ],
        others=expand(
            RESULTS / "tables" / "{table}.{suffix}",
            table=TABLES,
            suffix=["md", "tex"],
        ),
    log:
        LOGS / "tables.log",
    benchmark:
        BENCHMARKS / "tables.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        spread=CONFIG.evaluation.training_spread,
        code=code_digest("tables"),
    shell:
        "dine --log {log:q} tables {input:q} --spread {params.spread}"
        ' --out "$(dirname -- {output.all:q})"'


rule figures:
    input:
        METRICS,
        [
            FILES.run(*run, name)
            for run in RUNS
            for name in ("predictions.h5", "point_errors.h5", "history.csv")
        ],
        [FILES.dataset(dataset, "pairs.h5") for dataset in CONFIG.datasets],
        SEARCHES,
    output:
        figures=[
            report(
                RESULTS / "figures" / f"{figure}.png",
                caption="../report/figure.rst",
                category="Figures",
                labels={"figure": figure},
            )
            for figure in FIGURES
        ],
        pdf=expand(RESULTS / "figures" / "{figure}.pdf", figure=FIGURES),
    log:
        LOGS / "figures.log",
    benchmark:
        BENCHMARKS / "figures.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        settings=drawn_settings(),
        code=code_digest("figures"),
    shell:
        'drawn="$(dirname -- {output.figures[0]:q})";'
        ' dine --log {log:q} figures --results "$(dirname -- "$drawn")"'
        ' --settings {params.settings:q} --out "$drawn"'


rule resolved_config:
    output:
        RESULTS / "config.yaml",
    log:
        LOGS / "config.log",
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
        [FILES.run(*run, "run.json") for run in RUNS],
        [
            FILES.dataset(dataset, name)
            for dataset in CONFIG.datasets
            for name in ("agreement.json", "inventory.csv", "left_out.csv")
        ],
        rules.tables.output,
        rules.figures.output,
        rules.resolved_config.output,
        SEARCHES,
    output:
        report(
            RESULTS / "report.html", caption="../report/report.rst", category="Report"
        ),
    log:
        LOGS / "html.log",
    benchmark:
        BENCHMARKS / "html.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("reporting"),
    params:
        settings=whole_config(),
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
                FILES.run(dataset, backbone, method, "metrics.csv")
                for dataset in CONFIG.datasets
                for backbone in CONFIG.backbones_of(dataset)
                if PRIOR in CONFIG.backbones[backbone].priors
                for method in (dine_config.STAGE1, dine_config.CONTROL, PRIOR)
            ],
        output:
            RESULTS / "ablation" / PRIOR / "all.md",
        log:
            LOGS / "ablation" / f"{PRIOR}.log",
        benchmark:
            BENCHMARKS / "ablation" / f"{PRIOR}.tsv"
        conda:
            "../envs/dine.yaml"
        resources:
            **request("reporting"),
        params:
            spread=CONFIG.evaluation.training_spread,
            code=code_digest("tables"),
        shell:
            "dine --log {log:q} tables {input:q} --spread {params.spread}"
            ' --out "$(dirname -- {output:q})"'


# Handles for parts of the work.
rule data:
    input:
        [FILES.dataset(dataset, "agreement.json") for dataset in CONFIG.datasets],
        [
            FILES.variant(dataset, *condition)
            for dataset in CONFIG.datasets
            for condition in conditions(CONFIG, dataset)
        ],


rule train:
    input:
        [FILES.run(*run, "model.safetensors") for run in RUNS],

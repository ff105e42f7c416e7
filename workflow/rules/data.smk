# Raw meshes, index-consistent pairs, corrupted targets.


rule raw:
    output:
        raw=RESULTS / "{dataset}" / "raw.json",
        inventory=RESULTS / "{dataset}" / "inventory.csv",
        left_out=RESULTS / "{dataset}" / "left_out.csv",
    log:
        LOGS / "{dataset}" / "raw.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "raw.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=raw_settings,
        signature=raw_signature,
        seed=CONFIG.seed,
        code=code_digest("raw"),
    shell:
        "dine --log {log:q} raw --settings {params.settings:q} --seed {params.seed}"
        ' --out "$(dirname -- {output.raw:q})"'


rule pairs:
    input:
        rules.raw.output.raw,
    output:
        RESULTS / "{dataset}" / "pairs.h5",
    log:
        LOGS / "{dataset}" / "pairs.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "pairs.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=lambda wildcards: section(CONFIG.datasets[wildcards.dataset].pairs),
        seed=CONFIG.seed,
        code=code_digest("pairs"),
    shell:
        "dine --log {log:q} pairs --raw {input:q} --settings {params.settings:q}"
        " --seed {params.seed} --out {output:q}"


rule agreement:
    input:
        rules.pairs.output,
    output:
        RESULTS / "{dataset}" / "agreement.json",
    log:
        LOGS / "{dataset}" / "agreement.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "agreement.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        seed=CONFIG.seed,
        code=code_digest("agreement"),
    shell:
        "dine --log {log:q} agreement --pairs {input:q} --seed {params.seed} --out {output:q}"


rule corrupt:
    input:
        rules.pairs.output,
    output:
        RESULTS / "{dataset}" / "variants" / "{condition}_{corruption}.h5",
    log:
        LOGS / "{dataset}" / "variants" / "{condition}_{corruption}.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "variants" / "{condition}_{corruption}.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        seed=CONFIG.seed,
        code=code_digest("corrupt"),
    shell:
        "dine --log {log:q} corrupt --pairs {input:q} --condition {wildcards.condition}"
        " --level {wildcards.corruption} --seed {params.seed} --out {output:q}"

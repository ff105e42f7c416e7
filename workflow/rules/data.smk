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
        first=0,
        seed=CONFIG.seed,
        code=code_digest("raw"),
    shell:
        "dine --log {log:q} raw --settings {params.settings:q} --first-object {params.first}"
        ' --seed {params.seed} --out "$(dirname -- {output.raw:q})"'


# Further objects, which nothing is trained on.
use rule raw as raw_unseen with:
    output:
        raw=RESULTS / "{dataset}" / "unseen" / "raw.json",
        inventory=RESULTS / "{dataset}" / "unseen" / "inventory.csv",
        left_out=RESULTS / "{dataset}" / "unseen" / "left_out.csv",
    log:
        LOGS / "{dataset}" / "raw_unseen.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "raw_unseen.tsv"
    params:
        settings=unseen_settings,
        signature=unseen_signature,
        first=lambda wildcards: CONFIG.datasets[wildcards.dataset].recipe.objects,
        seed=CONFIG.seed,
        code=code_digest("raw"),


rule pairs:
    input:
        unpack(raw_files),
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
        unseen=unseen_option,
        settings=lambda wildcards: section(CONFIG.datasets[wildcards.dataset].pairs),
        seed=CONFIG.seed,
        code=code_digest("pairs"),
    shell:
        "dine --log {log:q} pairs --raw {input.raw:q} {params.unseen}"
        " --settings {params.settings:q} --seed {params.seed} --out {output:q}"


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
    wildcard_constraints:
        condition="noise|outliers",
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        most=most_option,
        seed=CONFIG.seed,
        code=code_digest("corrupt"),
    shell:
        "dine --log {log:q} corrupt --pairs {input:q} --condition {wildcards.condition}"
        " --level {wildcards.corruption} {params.most} --seed {params.seed} --out {output:q}"


rule resample:
    input:
        unpack(raw_files),
        pairs=rules.pairs.output,
    output:
        RESULTS / "{dataset}" / "variants" / "resampled_1.h5",
    log:
        LOGS / "{dataset}" / "variants" / "resampled_1.log",
    benchmark:
        BENCHMARKS / "{dataset}" / "variants" / "resampled_1.tsv"
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        raws=raw_options,
        most=most_option,
        seed=CONFIG.seed,
        code=code_digest("resample"),
    shell:
        "dine --log {log:q} resample {params.raws} --pairs {input.pairs:q}"
        " {params.most} --seed {params.seed} --out {output:q}"

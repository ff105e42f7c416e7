# Raw meshes, index-consistent pairs, corrupted targets.


rule raw:
    output:
        raw=DATA.raw,
        inventory=DATA.inventory,
        left_out=DATA.left_out,
    log:
        FILES.log("{dataset}", "raw"),
    benchmark:
        FILES.benchmark("{dataset}", "raw")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        settings=lambda wildcards: PLAN.raw(wildcards.dataset),
        signature=lambda wildcards: PLAN.raw_signature(wildcards.dataset),
        first=0,
        seed=CONFIG.seed,
        code=code_digest("raw"),
    shell:
        "dine --log {log:q} raw --settings {params.settings:q} --first-object {params.first}"
        ' --seed {params.seed} --out "$(dirname -- {output.raw:q})"'


# Further objects, which nothing is trained on.
use rule raw as raw_unseen with:
    output:
        raw=FILES.unseen("{dataset}").raw,
        inventory=FILES.unseen("{dataset}").inventory,
        left_out=FILES.unseen("{dataset}").left_out,
    log:
        FILES.log("{dataset}", "raw_unseen"),
    benchmark:
        FILES.benchmark("{dataset}", "raw_unseen")
    params:
        settings=lambda wildcards: PLAN.unseen(wildcards.dataset),
        signature=lambda wildcards: PLAN.unseen_signature(wildcards.dataset),
        first=lambda wildcards: CONFIG.datasets[wildcards.dataset].recipe.objects,


rule pairs:
    input:
        unpack(lambda wildcards: PLAN.raw_files(wildcards.dataset)),
    output:
        DATA.pairs,
    log:
        FILES.log("{dataset}", "pairs"),
    benchmark:
        FILES.benchmark("{dataset}", "pairs")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        more=lambda wildcards, input: options("--unseen", input[1:]),
        settings=lambda wildcards: section(CONFIG.datasets[wildcards.dataset].pairs),
        seed=CONFIG.seed,
        code=code_digest("pairs"),
    shell:
        "dine --log {log:q} pairs --raw {input.raw:q} {params.more}"
        " --settings {params.settings:q} --seed {params.seed} --out {output:q}"


rule agreement:
    input:
        rules.pairs.output,
    output:
        DATA.agreement,
    log:
        FILES.log("{dataset}", "agreement"),
    benchmark:
        FILES.benchmark("{dataset}", "agreement")
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
        DATA.variant("{condition}", "{corruption}"),
    log:
        FILES.log("{dataset}", "variants", "{condition}_{corruption}"),
    benchmark:
        FILES.benchmark("{dataset}", "variants", "{condition}_{corruption}")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        some=lambda wildcards: options("--most", PLAN.most_corrupted(wildcards.dataset)),
        seed=CONFIG.seed,
        code=code_digest("corrupt"),
    shell:
        "dine --log {log:q} corrupt --pairs {input:q} --condition {wildcards.condition}"
        " --level {wildcards.corruption} {params.some} --seed {params.seed} --out {output:q}"


rule resample:
    input:
        raws=lambda wildcards: [*PLAN.raw_files(wildcards.dataset).values()],
        pairs=rules.pairs.output,
    output:
        DATA.variant("resampled", 1),
    log:
        FILES.log("{dataset}", "variants", "resampled_1"),
    benchmark:
        FILES.benchmark("{dataset}", "variants", "resampled_1")
    conda:
        "../envs/dine.yaml"
    resources:
        **request("data"),
    params:
        raws=lambda wildcards, input: options("--raw", input.raws),
        some=lambda wildcards: options("--most", PLAN.most_corrupted(wildcards.dataset)),
        seed=CONFIG.seed,
        code=code_digest("resample"),
    shell:
        "dine --log {log:q} resample {params.raws} --pairs {input.pairs:q}"
        " {params.some} --seed {params.seed} --out {output:q}"

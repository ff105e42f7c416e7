# The workflow is workflow/Snakefile, where Snakemake's catalog and other workflows look for it. With the
# directive `include` its rule `all` would not be the default.
workflow.include("workflow/Snakefile", overwrite_default_target=True)

# The image in which jobs of the workflow run on Kubernetes, and Snakemake and dine anywhere else; how
# to build, try and push it: docs/guide/cluster.md. Everything comes in the versions of the locks.
FROM python:3.11-slim-bookworm

# The index of PyTorch's builds without CUDA, where no GPU is needed; pytorch.org names it.
ARG TORCH_INDEX=""
# What brings files to jobs and back; "" for none. Another storage has another plugin.
ARG STORAGE_PLUGIN="snakemake-storage-plugin-s3==0.3.6"

ENV PATH=/opt/venv/bin:$PATH \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PIP_NO_CACHE_DIR=1

WORKDIR /opt/dine
COPY requirements.lock requirements-torch.lock ./
# As `make install` does.
RUN python3 -m venv /opt/venv \
    && pip install --require-hashes --no-deps --requirement requirements.lock \
    && pip install ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} --requirement requirements-torch.lock
# The plugin's own needs are not locked; pip changes what is there only where it cannot do otherwise.
RUN if [ -n "$STORAGE_PLUGIN" ]; then pip install "$STORAGE_PLUGIN"; fi && pip check

# The repository's package and workflow, as in a checkout: snakemake -s /opt/dine/Snakefile
COPY pyproject.toml setup.py README.md LICENSE Snakefile config.yaml ./
COPY dine dine
COPY config config
COPY profiles profiles
COPY workflow workflow
RUN pip install --no-deps --no-build-isolation --editable . && pip check

# Whoever runs it, be it a number without a name, may keep compiled code and what Snakemake reads.
ENV USER=dine \
    NUMBA_CACHE_DIR=/var/cache/dine/numba \
    XDG_CACHE_HOME=/var/cache/dine
RUN useradd --create-home --uid 1000 dine \
    && install --directory --mode 1777 /var/cache/dine \
    && install --directory --owner dine /work
USER dine
WORKDIR /work
# The image works, or it is not built; and nobody waits for numba later.
RUN umask 000 \
    && dine scans trial \
    && dine register trial/before.ply trial/after.ply -o trial/moved.ply \
    && snakemake --version \
    && rm -r trial

CMD ["dine", "--help"]

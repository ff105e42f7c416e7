"""A backbone, a prior, a data term and a dataset of one's own; see docs/guide/extending.md."""

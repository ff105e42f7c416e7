"""Does a deformation prior help, which one, where and by how much: the report on the evidence.

Every number comes from ``metrics.csv`` files by way of ``dine.evaluation.statistics``; so do the
verdicts. A *place* is a dataset with a backbone. Methods without a network are shown at every place
of their datasets.
"""

from dine.reporting.evidence.comparisons import EvidenceStatistics, load_evidence
from dine.reporting.evidence.report import ExamplePicture, Files, build_evidence

__all__ = ["EvidenceStatistics", "ExamplePicture", "Files", "build_evidence", "load_evidence"]

"""DINE: non-rigid registration of soft-tissue point clouds with learned deformation priors."""

__version__ = "0.1.0"

"""Errors meant for the user: one sentence naming the file, key or value, and what to do."""


class DineError(Exception):
    """Base of every error that the command line prints as one line, without a traceback."""


class ConfigError(DineError):
    """A configuration key or value, or a combination of them, that cannot be used."""


class DataError(DineError):
    """An input file or array that cannot be read or does not hold what it should."""


class CheckpointError(DineError):
    """Weights, a prior or a training state that does not fit or is damaged."""


class DownloadError(DineError):
    """A dataset that could not be fetched."""


class StorageError(DineError):
    """An output that could not be written."""

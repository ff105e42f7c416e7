"""Compiled CPU kernels of the hot paths; their eager forms, beside the callers, work anywhere.

Each kernel runs over a range of blocks and releases the interpreter lock, so a pool of threads
shares the blocks out. What a block adds up is added up again in a fixed order, so results do not
depend on the number of threads.
"""

from dine.models.compiled.parallel import supported

__all__ = ["supported"]

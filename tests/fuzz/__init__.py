"""Mutated files for every reader: what is not read correctly must be refused by an error of ours.

``python -m fuzz --inputs 12000`` (``make fuzz``) and ``test_fuzz.py`` run the same code.
"""

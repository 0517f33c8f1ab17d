"""The tables of the RTMap paper, measured."""

"""The mission, one room per verb: pure functions on arrays and tables."""

"""Localization: bounds, robustness, speed."""

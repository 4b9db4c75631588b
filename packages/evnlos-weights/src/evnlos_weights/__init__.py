"""Pretrained networks of `evnlos`, the calibrated setups that they belong to, and their SHA-256: data alone."""

"""Experiments that leave a record: one run, its settings, curve, model and evaluation."""

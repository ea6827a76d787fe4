"""Accuracy and integrity: flights, single matches, scores, poses and audits, each against known truth."""

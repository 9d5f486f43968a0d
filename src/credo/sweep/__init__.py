"""Hyperparameter search: trials with several seeds each, the same however often it is stopped and
however many processes train."""

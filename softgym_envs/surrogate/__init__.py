"""Learned condensed models: sampling, dataset, networks, training, the trained model and pretrained weights."""

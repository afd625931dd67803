"""d3rlpy: offline SAC on recorded arrays; its pin of Gymnasium needs an environment without softgym-envs.

Usage: ``python d3rlpy_offline.py FILE.npz``, with the file of minari_dataset.py.
"""

import sys

import d3rlpy
import numpy as np

columns = dict(np.load(sys.argv[1]))
dataset = d3rlpy.dataset.MDPDataset(**columns)
algorithm = d3rlpy.algos.SACConfig(batch_size=64).create(device="cpu")
algorithm.fit(
    dataset, n_steps=50, n_steps_per_epoch=50, save_interval=10, logger_adapter=d3rlpy.logging.NoopAdapterFactory()
)
print(algorithm.predict(columns["observations"][:3]).shape)

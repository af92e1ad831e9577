"""Many tasks on many processes or machines: whole folders of logs, and experiments.

`engine` runs tasks, by processes of this machine or by a Dask cluster. See docs/clusters.md.
"""

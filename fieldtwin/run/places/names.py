"""The values of `--on`, the option that says where a campaign runs."""

LOCAL = "local"
DASK = "dask://"
SLURM = "slurm"
KUBERNETES = "kubernetes"
PLACES = (LOCAL, DASK, SLURM, KUBERNETES)

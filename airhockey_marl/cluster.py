"""Ray clusters: one that this machine belongs to, one elsewhere, or one started here for the purpose."""

HERE = "local"  # a cluster of this machine, for the purpose


def join(address: str, cores: int | None = None) -> None:
    """Join a Ray cluster, unless this process has joined one already.

    Args:
        address: "local", "auto" or host:port.
        cores: that a cluster started here has; all of this machine if None.
    """
    import ray  # an extra

    if not ray.is_initialized():
        where = {"num_cpus": cores} if address == HERE else {"address": address}
        ray.init(**where, include_dashboard=False, log_to_driver=False)

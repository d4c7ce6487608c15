"""Where tasks run."""

from __future__ import annotations

from bbfit.workers.cluster import RayWorkers
from bbfit.workers.config import WorkersConfig
from bbfit.workers.local import LocalWorkers
from bbfit.workers.tasks import Workers


def workers_of(config: WorkersConfig) -> Workers:
    """The processes on this machine or the machines of a Ray cluster. InputError if Ray is not installed."""
    return LocalWorkers(config.workers, config.retries) if config.ray is None else RayWorkers(config)

"""The hot loops of the field, compiled by numba; `stages.nerf.twin` is their plain counterpart."""

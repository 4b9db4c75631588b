"""Event models in numba and torch: arrays of pixels, and the kernels that advance them."""

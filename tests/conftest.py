"""One thread everywhere, as in a training process, so that what the tests compare bit by bit is comparable."""

import torch

torch.set_num_threads(1)

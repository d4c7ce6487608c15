"""Differentiable operators, one folder each: the reference implementation, the fused implementation and its kernels.

``reference.py`` is the specification, in torch, for any precision, differentiated by autograd. ``fused.py`` computes the same with
Warp kernels in float32, on the CPU and on CUDA from one source. ``*kernels.py`` hold the kernels and derive the hand-written backward
pass. The two implementations share a stem and a signature, for example ``ssim_reference`` and ``ssim_fused``; tests compare their
values and gradients. ``cards`` draws what exported files show, which nothing differentiates.
"""

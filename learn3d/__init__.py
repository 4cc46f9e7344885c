"""learn3d: pose-invariant 3D reconstruction from single-view images (Peng et al. 2020), through
the `nmr` renderer.
"""

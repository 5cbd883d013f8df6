"""Everything that Warp compiles. Kernels never see torch, allocate, or launch."""

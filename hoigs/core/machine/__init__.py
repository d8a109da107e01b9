"""What the machine offers: `cpus` counts processors, `quiet_warp` starts Warp, `python` starts
Python; and how this process uses it: `busy` lets threads wait, `memory` keeps what was freed."""

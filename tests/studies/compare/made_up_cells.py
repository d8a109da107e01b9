"""Made-up results for tests of what is drawn and said: nobody trained anything."""

from __future__ import annotations

import random

from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.studies.compare.data import Cell

A = "Xeon A, 2 cores; torch 2.13.0, warp 1.19.0"
B = "Ryzen B, 8 cores; torch 2.13.0, warp 1.19.0"
NO_JOULES = NotComputed("this machine does not tell")
PROTOCOL = ("2 frames of split 'test' from training cameras.", "32x32, float pixels.")

# spec: PSNR human + object, training s and parameters at 1000 steps
METHODS = {
    "hoigs": (26.4, 140.0, 1.9e6),
    "4dgs": (23.1, 118.0, 3.4e6),
    "d3dgs": (23.9, 190.0, 2.6e6),
    "e-d3dgs": (24.2, 131.0, 2.9e6),
    "exavatar": (21.7, 96.0, 1.5e6),
    "hugs": (22.3, 88.0, 2.2e6),
    "k-planes-gs": (22.9, 112.0, 4.1e6),
    "static-3dgs": (13.2, 31.0, 0.6e6),
    "hoigs + acme-bounce": (25.8, 128.0, 1.8e6),
}


def cell(spec: str = "hoigs", psnr: float = 20.0, train_s: float = 10.0, **more: object) -> Cell:
    """One cell with two numbers, and any others by keyword."""
    fields = {"definition": spec, "rasterizer": "warp", "steps": 100, "clip": "carry", "seed": 0,
              "run": f"runs/carry/{spec}", "machine": A, "protocol": PROTOCOL}  # fmt: skip
    named = {k: more.pop(k) for k in list(more) if k in (*fields, "curve", "missing", "at_once")}
    values: dict[str, Value] = {"psnr_human_object": psnr, "train_s": train_s, **more}  # type: ignore[dict-item]
    return Cell(spec=spec, values=values, **{**fields, **named})  # type: ignore[arg-type]


def study(
    methods: dict[str, tuple[float, float, float]] = METHODS,
    clips: tuple[str, ...] = ("carry",),
    machines: tuple[str, ...] = (A,),
    rasterizers: tuple[str, ...] = ("warp",),
    seeds: int = 3,
    lpips: bool = True,
) -> list[Cell]:
    """A study of plausible shape: more steps score higher, by less and less."""
    noise = random.Random(0)
    found = []
    for clip in clips:
        for k, machine in enumerate(machines):
            for rasterizer in rasterizers:
                for spec, (psnr, train_s, parameters) in methods.items():
                    for steps, share in ((200, 0.2), (1000, 1.0)):
                        for seed in range(seeds):
                            top = psnr - 1.6 * (1 - share) + noise.gauss(0, 0.12)
                            seconds = train_s * share * (1 + 0.7 * k) * noise.gauss(1, 0.02)
                            seconds *= 9 if rasterizer == "torch" else 1
                            curve = tuple(
                                (int(steps * i / 8), seconds * i / 8,
                                 top - 7 * 2.718 ** (-5 * i / 8))
                                for i in range(1, 9)
                            )  # fmt: skip
                            found.append(cell(
                                spec, top, seconds, seed=seed, steps=steps, clip=clip,
                                machine=machine, rasterizer=rasterizer, curve=curve,
                                psnr_full=top + 6 + noise.gauss(0, 0.05),
                                lpips_human_object=0.5 - 0.014 * top if lpips
                                else NotComputed("no LPIPS weights"),
                                lpips_full=0.4 - 0.01 * top if lpips
                                else NotComputed("no LPIPS weights"),
                                render_ms=4 + parameters / 1e6 * noise.gauss(1, 0.02),
                                parameters=parameters, megabytes=parameters * 4e-6,
                                joules=NO_JOULES, memory_mb=600 + parameters * 4e-5,
                            ))  # fmt: skip
    return found

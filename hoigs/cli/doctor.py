"""`hoigs doctor`: what this machine has, and what each part of hoigs makes of it."""

from __future__ import annotations

import typer

from hoigs.cli.common import print_table


def doctor() -> None:
    """Check the installation: versions, devices, rasterizers, bodies, LPIPS weights."""
    from hoigs.core.registry import default_registry
    from hoigs.evaluation.lpips import find_weights
    from hoigs.training.run_folder import versions

    rows = [(name, version, "") for name, version in versions().items()]
    rows += _devices()
    registry = default_registry()
    failed = False
    for key in registry.keys("rasterizer"):
        verdict, note = _try_rasterizer(registry.get(key))
        failed |= not verdict.startswith("ok")
        rows.append((key, verdict, note))
    found = find_weights()
    rows.append(("LPIPS weights", found.location or "none", found.reason))
    print_table("hoigs doctor", ("what", "found", "note"), rows)
    if failed:
        raise typer.Exit(1)


def _devices() -> list[tuple[str, str, str]]:
    import torch

    threads = f"{torch.get_num_threads()} torch threads"
    rows = [("cpu", "ok", threads)]
    if torch.cuda.is_available():
        rows.append(("cuda", "ok", torch.cuda.get_device_name(0)))
    else:
        rows.append(("cuda", "none", "everything runs on the CPU"))
    return rows


def _try_rasterizer(backend: type) -> tuple[str, str]:
    """Draw one Gaussian and look at the pixel in its middle; and what the backend runs on."""
    import torch

    from hoigs.core.camera import Camera
    from hoigs.core.gaussians import Gaussians

    points = torch.tensor([[0.0, 0.0, 2.0]])
    red = Gaussians.from_points(points, torch.tensor([[1.0, 0.0, 0.0]]), scales=0.2, opacity=0.9)
    K = torch.tensor([[32.0, 0, 8.5], [0, 32.0, 8.5], [0, 0, 1]])
    rasterizer = backend()
    output = rasterizer.render(red, Camera(K, torch.eye(4), 17, 17))
    report: dict[str, str] = getattr(rasterizer, "backend_report", dict)()
    note = ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in report.items())
    middle = output.color[8, 8]
    if abs(float(middle[0]) - 0.9) < 1e-3 and float(middle[1:].abs().max()) < 1e-3:
        return "ok: drew a test splat", note
    return f"wrong: test splat is {middle.tolist()}, expected [0.9, 0, 0]", note

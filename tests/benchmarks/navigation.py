"""
Accuracy and honesty of the navigation: simulated flights, the simulated survey of other code, and a real aircraft.

    python tests/benchmarks/navigation.py [--flights 20] [--outage-flights 40] [--data ../shared/data]

Errors of position are counted without the constant offset of the GPS, which no filter can see.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from simulated_flights import nees
from thor75 import read_thor75

from changedetect.io.flight import read_flight
from changedetect.navigation.alignment import attitude_from_angles, attitude_to_angles
from changedetect.navigation.flight import ImuNoise
from changedetect.navigation.photos import camera_poses
from changedetect.navigation.solution import NavigationSettings, navigate
from changedetect.synthetic.flight_path import FlightPlan, GpsErrors, simulate_flight

CLASSES = {"low": ImuNoise(), "mid": ImuNoise.mid()}
DOF = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9), "all nine": slice(0, 9)}


def rms(values: np.ndarray) -> np.ndarray:
    """Root mean square over rows."""
    return np.sqrt(np.mean(values**2, axis=0))


def triple(values: np.ndarray, digits: int) -> str:
    """Three numbers as E/N/U."""
    return "/".join(f"{v:.{digits}f}" for v in values)


def simulated_survey(n_flights: int) -> None:
    """NEES per degree of freedom and errors at the photos, mean over flights of 6 strips."""
    one = simulate_flight()
    print(
        f"\n## {n_flights} simulated flights a class, {one.path.end:.0f} s, {len(one.flight.photos)} photos, GPS 5 Hz "
        "2 m + 1 m offset; photos after the first minute"
    )
    for name, noise in CLASSES.items():
        ratios: dict[str, list[list[float]]] = {"filtered": [], "smoothed": []}
        errors: dict[str, list[np.ndarray]] = {"filtered": [], "smoothed": []}
        for seed in range(n_flights):
            simulated = simulate_flight(imu_noise=noise, gps=GpsErrors(offset_std=1.0), seed=seed)
            solution = navigate(simulated.flight)
            rows = np.flatnonzero(solution.timeline.photo >= 0)
            rows = rows[solution.timeline.time[rows] > 60.0]  # attitude has settled after the first strip
            together = np.diff(solution.timeline.time[rows]) < 0.4
            for kind, values in ratios.items():
                path = getattr(solution, kind)
                error = simulated.error_state(
                    path.time[rows], path.position[rows], path.velocity[rows], path.rotation[rows]
                )
                error[:, :3] += simulated.gps_offset
                P = path.covariance[rows][:, :9, :9]
                values.append([nees(error[:, part], P[:, part, part]) for part in DOF.values()])
                change = np.diff(error, axis=0)[together]
                errors[kind].append(np.concatenate([rms(error), rms(change)]))
        for kind, values in ratios.items():
            mean, spread = np.mean(values, axis=0), np.std(values, axis=0)
            text = ", ".join(f"{part} {m:.2f} (sd {s:.2f})" for part, m, s in zip(DOF, mean, spread, strict=True))
            e = rms(np.array(errors[kind]))
            print(f"{name} {kind}: NEES/dof {text}")
            print(
                f"    photo to photo {triple(e[9:12], 3)} m {triple(np.degrees(e[15:18]), 4)} deg; "
                f"absolute {triple(e[:3], 2)} m {triple(np.degrees(e[6:9]), 2)} deg"
            )


def outages(n_flights: int) -> None:
    """Largest error inside an outage, and how often it lies within two standard deviations."""
    print(f"\n## GPS outages from 100 s on, {n_flights} flights each")
    for name, noise in CLASSES.items():
        for length in (10.0, 30.0, 60.0):
            rows: dict[str, list[list[float]]] = {"filtered": [], "smoothed": []}
            for seed in range(n_flights):
                gps = GpsErrors(outages=((100.0, 100.0 + length),))
                simulated = simulate_flight(FlightPlan(n_strips=5), noise, gps, seed=seed)
                solution = navigate(simulated.flight, NavigationSettings(gps_latency=0.0))
                inside = (solution.timeline.time > 100.0) & (solution.timeline.time < 100.0 + length)
                for kind, values in rows.items():
                    path = getattr(solution, kind)
                    error = simulated.error_state(
                        path.time[inside], path.position[inside], path.velocity[inside], path.rotation[inside]
                    )[:, :3]
                    P = path.covariance[inside][:, :3, :3]
                    std = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
                    size = float(np.linalg.norm(error, axis=1).max())
                    values.append([size, float(np.mean(np.abs(error) < 2 * std)), nees(error, P)])
            for kind, values in rows.items():
                size, covered, ratio = np.mean(values, axis=0)
                print(
                    f"{name} {length:.0f} s {kind}: largest error {size:.1f} m, within 2 sigma {100 * covered:.0f} %, "
                    f"NEES/dof {ratio:.2f}"
                )


def other_simulator(data: Path) -> None:
    """Poses of data/flight_sim against its truth."""
    print("\n## flight_sim: poses against truth (47 photos an epoch)")
    for epoch in ("epoch1", "epoch2"):
        flight = read_flight(data / "flight_sim" / epoch)
        with (data / "flight_sim" / "truth" / f"poses_{epoch}.csv").open() as stream:
            truth = list(csv.DictReader(stream))
        place = np.array([[float(row[c]) for c in "xyz"] for row in truth])
        angles = [[float(row[f"body_{c}_deg"]) for c in ("roll", "pitch", "yaw")] for row in truth]
        turned = np.stack([attitude_from_angles(*a) for a in angles]) @ flight.mount.rotation_body_camera
        begin = time.process_time()
        solution = navigate(flight)
        seconds = time.process_time() - begin
        together = np.diff(flight.photos.time) < 0.4
        for kind, causal in (("EKF", True), ("RTS", False)):
            poses = camera_poses(flight, solution, causal=causal)
            shift = place - poses.position
            turn = Rotation.from_matrix(turned @ poses.rotation.transpose(0, 2, 1)).as_rotvec()
            error = np.hstack([shift, turn])
            change = rms(np.diff(error, axis=0)[together])
            print(
                f"{epoch} {kind}: absolute {triple(rms(shift), 2)} m (mean {triple(shift.mean(axis=0), 2)}, about it "
                f"{triple(shift.std(axis=0), 2)}), {triple(np.degrees(rms(turn)), 3)} deg; photo to photo "
                f"{triple(change[:3], 3)} m {triple(np.degrees(change[3:]), 3)} deg"
            )
        ratio = nees(error[1:], poses.total_covariance[1:])
        print(f"    NEES/dof of the smoothed poses, GPS offset included: {ratio:.2f}; CPU time {seconds:.2f} s")


def real_aircraft(data: Path) -> None:
    """Thor flight 75 against its onboard filter."""
    print("\n## UMN Thor flight 75: difference from the onboard EKF while airborne (347 s)")
    flight, onboard = read_thor75(data / "ins_umn_thor75")
    solution = navigate(flight)
    fast = flight.gps.time[np.linalg.norm(flight.gps.velocity, axis=1) > 10.0]
    moments = solution.timeline.time
    rows = np.flatnonzero((moments > fast[0] + 10.0) & (moments < fast[-1] - 10.0))
    near = np.searchsorted(onboard.time, moments[rows])
    near -= np.abs(onboard.time[near - 1] - moments[rows]) < np.abs(onboard.time[near] - moments[rows])
    for kind in ("filtered", "smoothed"):
        path = getattr(solution, kind)
        velocity = path.velocity[rows] - onboard.velocity[near]
        angle = attitude_to_angles(path.rotation[rows]) - attitude_to_angles(onboard.rotation[near])
        angle = (angle + 180.0) % 360.0 - 180.0
        print(
            f"{kind}: velocity E/N/U {triple(rms(velocity), 2)} m/s; roll/pitch/yaw rms {triple(rms(angle), 2)} deg, "
            f"mean {triple(angle.mean(axis=0), 2)} deg"
        )
    latency = solution.latency
    print(f"    GPS delay {latency.seconds:.3f} +- {latency.std:.3f} s; {solution.n_refused} fixes refused")


def main() -> None:
    """Run all parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--outage-flights", type=int, default=40)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("CHANGEDETECT_DATA", "../shared/data")))
    arguments = parser.parse_args()
    if arguments.data.is_dir():
        other_simulator(arguments.data)
        real_aircraft(arguments.data)
    else:
        print(f"no real data under {arguments.data}; parts left out")
    simulated_survey(arguments.flights)
    outages(arguments.outage_flights)


if __name__ == "__main__":
    main()

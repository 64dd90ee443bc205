"""Report of `polypod deploy check`."""

from polypod.deploy.check import BOUND, Check
from polypod.tables import Rows, console_of_output


def show(check: Check) -> None:
    """Prints the figures."""
    console = console_of_output()
    contract = check.contract
    console.print(
        f"{check.file}: {contract.robot}, {len(contract.joints)} joints, {1.0 / contract.control_dt:g} Hz, "
        f"{contract.graph} graph; {check.task}, {check.num_envs} robots, compared with {check.reference} (largest "
        f"differences, at most {BOUND:g})",
        markup=False,
    )
    table = Rows("simulator", "steps", "observation", "action", "target rad", "falls", "faults", "agrees")
    for name, played in check.played.items():
        faults = ", ".join(f"{count} {fault}" for fault, count in sorted(played.faults.items())) or "-"
        differences = (f"{value:.1e}" for value in (played.observation, played.action, played.target))
        table.add_row(name, str(played.steps), *differences, str(played.falls), faults, "yes" if played.holds else "no")
    table.print(console)
    for name in contract.estimated:
        console.print(f"  {name}: no sensor measures it; the robot needs an estimator", markup=False)
    for name in contract.mapped:
        console.print(f"  {name}: the robot needs a map of the ground", markup=False)

"""Writes the bill of materials (CycloneDX 1.6, JSON) of a folder of installed Python packages.

    python deploy/sbom.py /opt/spiked/lib/python3.11/site-packages > sbom.json

Each package has name, version, licence and the digest of its own list of files (RECORD). There is no time in it: the
same packages give the same bytes.
"""

import hashlib
import json
import sys
import uuid
from importlib import metadata
from pathlib import Path
from typing import Any


def component(package: metadata.Distribution) -> dict[str, Any]:
    """One package."""
    name = package.metadata["Name"].lower().replace("_", "-")
    about: dict[str, Any] = {
        "type": "library",
        "bom-ref": f"{name}@{package.version}",
        "name": name,
        "version": package.version,
        "purl": f"pkg:pypi/{name}@{package.version}",
    }
    record = package.read_text("RECORD")
    if record:
        about["hashes"] = [{"alg": "SHA-256", "content": hashlib.sha256(record.encode()).hexdigest()}]
    expression, classifiers = package.metadata["License-Expression"], package.metadata.get_all("Classifier") or []
    named = [one.rsplit(" :: ", 1)[1] for one in classifiers if one.startswith("License :: ")]
    if expression:
        about["licenses"] = [{"expression": expression}]
    elif named:
        about["licenses"] = [{"license": {"name": name}} for name in sorted(set(named))]
    return about


def bill(folder: Path) -> dict[str, Any]:
    """The document of all packages in a folder."""
    found = [component(package) for package in metadata.distributions(path=[str(folder)])]
    parts = sorted(found, key=lambda one: str(one["bom-ref"]))
    own = next((one for one in parts if one["name"] == "spiked"), None)
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, digest)}",
        "version": 1,
        "metadata": {"component": {**own, "type": "application"}} if own else {},
        "components": [one for one in parts if one is not own],
    }


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit("usage: sbom.py FOLDER, a folder of installed packages (site-packages)")
    print(json.dumps(bill(Path(sys.argv[1])), indent=1))

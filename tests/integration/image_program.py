"""Run inside of an image: import all of our modules, and compute with the libraries that are linked to others.

Prints the packages that our modules ask for and that are not in the image.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import pkgutil
import platform
import sqlite3
import ssl
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path


def lacking() -> set[str]:
    """Import every module of ours; anything else than a missing package ends the program."""
    missing: set[str] = set()
    for name in modules():
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            missing.add(str(error.name))
    return missing


def modules() -> Iterator[str]:
    """The modules that are in the image under our names, but for those that are programs."""
    for package in pkgutil.iter_modules():
        if package.name.startswith("fractus"):
            found = importlib.import_module(package.name)
            for module in pkgutil.walk_packages(found.__path__, package.name + "."):
                if not module.name.endswith("__main__"):
                    yield module.name


def packages() -> None:
    """The versions that scanners read are of what runs."""
    records = Path("/var/lib/dpkg/status.d")
    assert f"Version: {platform.python_version()}-" in (records / "libpython3.11-stdlib").read_text()
    assert f"Version: {ssl.OPENSSL_VERSION.split()[1]}-" in (records / "libssl3").read_text()
    assert f"Version: {sqlite3.sqlite_version}-" in (records / "libsqlite3-0").read_text()


def linear_algebra() -> None:
    """Each routine of BLAS and LAPACK that numpy calls, in each of its types, against the equation that it solves."""
    import numpy as np
    import numpy.ma

    random = np.random.default_rng(1)
    for kind, close in (("f", 1e-2), ("F", 1e-2), ("d", 1e-8), ("D", 1e-8)):
        a, b = (random.standard_normal((2, 60, 60)) + 1j * random.standard_normal((2, 60, 60))).astype("D")
        if kind in "fd":
            a, b = a.real, b.real
        a, b = a.astype(kind), b.astype(kind)
        vectors, values, others = np.linalg.svd(a)
        q, r = np.linalg.qr(a)
        roots, turned = np.linalg.eig(a)
        levels, axes = np.linalg.eigh(a + a.conj().T)
        positive = a @ a.conj().T + 60 * np.eye(60, dtype=kind)
        triangle = np.linalg.cholesky(positive)
        for got, wanted in (
            (a @ b, np.einsum("ij,jk", a, b)),
            (a @ a.T, np.einsum("ij,kj", a, a)),
            (a @ b[0], np.einsum("ij,j", a, b[0])),
            (np.dot(a[0], b[0]), np.einsum("i,i", a[0], b[0])),
            (np.vdot(a[0], b[0]), np.einsum("i,i", a[0].conj(), b[0])),
            (a @ np.linalg.solve(a, b), b),
            (a @ np.linalg.inv(a), np.eye(60)),
            (a @ np.linalg.lstsq(a, b, rcond=None)[0], b),
            (vectors * values @ others, a),
            (q @ r, a),
            (a @ turned, turned * roots),
            ((a + a.conj().T) @ axes, axes * levels),
            (triangle @ triangle.conj().T, positive),
        ):
            assert np.allclose(got, wanted, atol=close), (kind, got, wanted)


def geometry() -> None:
    """An area with a hole, and the length of a degree of the meridian at the equator."""
    import shapely
    from geographiclib.geodesic import Geodesic

    square = shapely.box(0, 0, 10, 10).difference(shapely.Point(5, 5).buffer(1, quad_segs=64))
    assert abs(square.area - (100 - 3.14159)) < 1e-3
    assert shapely.STRtree([square]).query(shapely.Point(1, 1), predicate="within").tolist() == [0]
    assert abs(Geodesic.WGS84.Inverse(0, 0, 1, 0)["s12"] - 110574.389) < 1e-3


def pictures() -> None:
    """What filters call of OpenCV and Pillow, and OpenCV's linear algebra."""
    import numpy as np
    from fractus_services.camera.face_detection import CascadeDetector
    from fractus_services.camera.filters import moving
    from fractus_services.camera.pixels import decoded, encoded, opencv

    cv2 = opencv()
    random = np.random.default_rng(1)
    picture = cv2.GaussianBlur(random.integers(0, 255, (480, 640, 3), np.uint8), (0, 0), 3)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    assert decoded(encoded(picture)).shape == picture.shape
    assert cv2.imdecode(cv2.imencode(".png", picture)[1], cv2.IMREAD_COLOR).tolist() == picture.tolist()
    assert cv2.imdecode(cv2.imencode(".avif", picture)[1], cv2.IMREAD_COLOR).shape == picture.shape
    assert moving(np.roll(picture, 3, axis=1), picture, np.roll(picture, -3, axis=1), fixed=False) is not None
    assert CascadeDetector().find(picture, 60.0, upright=True) is not None
    a = random.standard_normal((200, 200))
    assert np.allclose(cv2.gemm(a, cv2.invert(a)[1], 1.0, None, 0.0), np.eye(200))
    for method in (cv2.DECOMP_LU, cv2.DECOMP_SVD, cv2.DECOMP_QR):
        assert np.allclose(a @ cv2.solve(a, a[0].copy(), flags=method)[1], a[0][:, None])
    for path in ("/tmp/none.mp4", "http://127.0.0.1:9/none"):
        assert not cv2.VideoCapture(path, cv2.CAP_FFMPEG).isOpened()
        assert not cv2.VideoCapture(path).isOpened()
    assert not cv2.VideoCapture("/dev/video9", cv2.CAP_V4L2).isOpened()


def calls() -> None:
    """One call to a server of gRPC over TLS."""
    import datetime

    import grpc
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder(
            name, name, key.public_key(), x509.random_serial_number(), now, now.replace(year=now.year + 1)
        )
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
        .public_bytes(serialization.Encoding.PEM)
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    server = grpc.server(ThreadPoolExecutor(1))
    echo = grpc.unary_unary_rpc_method_handler(lambda request, _: request)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("test.Echo", {"Say": echo}),))
    port = server.add_secure_port("127.0.0.1:0", grpc.ssl_server_credentials([(private, certificate)]))
    server.start()
    with grpc.secure_channel(
        f"127.0.0.1:{port}",
        grpc.ssl_channel_credentials(certificate),
        options=[("grpc.ssl_target_name_override", "localhost")],
    ) as channel:
        assert channel.unary_unary("/test.Echo/Say")(b"heard", timeout=20) == b"heard"
    server.stop(None)


def main() -> None:
    """Run what the image has libraries for."""
    found = lacking()
    packages()
    for library, check in (
        ("numpy", linear_algebra),
        ("shapely", geometry),
        ("cv2", pictures),
        ("cryptography", calls),
    ):
        if importlib.util.find_spec(library):
            check()
    names = {distribution.metadata["Name"] for distribution in importlib.metadata.distributions()}
    assert {"grpcio", "protobuf", "fractus-drones"} <= names
    print(json.dumps(sorted(found)), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()

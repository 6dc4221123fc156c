# Images of Fractus: docker build --target operator --tag localhost/fractus/operator:dev .
# Each is Debian with Python, a virtual environment in /opt/fractus, and the code as the last layer.
# Applications build on the image `component`. A release passes BASE with a digest (debian:trixie-slim@sha256:...).
ARG BASE=debian:trixie-slim

FROM ${BASE} AS base
ARG BASE
LABEL org.opencontainers.image.base.name=${BASE}
# Builds reset the time stamps of files, so bytecode must not be checked against them.
RUN apt-get update -q \
 && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends python3 iproute2 nftables procps >/dev/null \
 && rm -rf /var/lib/apt/lists/* /var/cache/* /var/log/* \
 && python3 -m compileall -qf --invalidation-mode unchecked-hash /usr/lib/python3.13 \
 && echo 'fractus:x:10001:10001::/home/fractus:/bin/sh' >> /etc/passwd && echo 'fractus:x:10001:' >> /etc/group && mkdir /home/fractus && chown 10001:10001 /home/fractus
ENV PATH=/opt/fractus/bin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 \
    PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1

# ---- build: a virtual environment for each image, with the locked dependencies and without the code
FROM base AS build
ARG UV_VERSION=0.13.8
# The CA bundle of a proxy in front of the package index, mounted for the build only.
ARG SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt
ENV SSL_CERT_FILE=${SSL_CERT_FILE} PIP_CERT=${SSL_CERT_FILE} UV_PYTHON=/usr/bin/python3 UV_PYTHON_DOWNLOADS=never \
    UV_LINK_MODE=copy UV_PROJECT_ENVIRONMENT=/opt/fractus UV_COMPILE_BYTECODE=1 PYC_INVALIDATION_MODE=UNCHECKED_HASH
RUN apt-get update -q \
 && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends ca-certificates python3-venv >/dev/null \
 && python3 -m venv /opt/uv && /opt/uv/bin/pip install --quiet --no-cache-dir uv==${UV_VERSION}
WORKDIR /build
COPY pyproject.toml uv.lock /build/
COPY sim/pyproject.toml /build/sim/
RUN --mount=type=cache,target=/root/.cache/uv mkdir /environments \
 && sync() { name=$1; shift; /opt/uv/bin/uv sync --quiet --frozen --no-dev --no-install-workspace "$@" && mv /opt/fractus "/environments/$name"; } \
 && sync component && sync operator --extra operator && sync agent --extra agent && sync mobility --extra mobility \
 && sync camera --extra services && sync view --extra view && sync sim --package fractus-sim

# ---- code: the distributions fractus-drones and fractus-sim without dependencies; .dockerignore selects the build context
FROM build AS code
COPY . /build/
RUN --mount=type=cache,target=/root/.cache/uv /opt/uv/bin/uv build --quiet --wheel --all-packages --out-dir /wheels \
 && for name in fractus_drones fractus_sim; do \
      python3 -m venv --without-pip /opt/fractus && /opt/uv/bin/uv pip install --quiet --python /opt/fractus --no-deps /wheels/$name-*.whl \
      && rm -f /opt/fractus/lib/python3.13/site-packages/*.dist-info/uv_cache.json && mv /opt/fractus /$name; done

# ---- images
FROM base AS component
COPY --from=build /environments/component /opt/fractus
USER 10001:10001
WORKDIR /home/fractus
ENTRYPOINT ["python3"]
COPY --from=code /fractus_drones /opt/fractus
FROM component AS example-traffic-monitoring
COPY examples/traffic-monitoring/*.py /app/
WORKDIR /app
FROM component AS example-field
COPY examples/field/*.py /app/
WORKDIR /app
FROM component AS example-links
COPY examples/links/*.py /app/
WORKDIR /app

FROM base AS operator
COPY --from=build /environments/operator /opt/fractus
USER 10001:10001
ENTRYPOINT ["python3", "-m", "fractus_operator"]
COPY --from=code /fractus_drones /opt/fractus
FROM base AS view
COPY --from=build /environments/view /opt/fractus
USER 10001:10001
ENTRYPOINT ["fractus", "view"]
COPY --from=code /fractus_drones /opt/fractus
FROM base AS agent
COPY --from=build /environments/agent /opt/fractus
ENTRYPOINT ["python3", "-m", "fractus_agent"]
COPY --from=code /fractus_drones /opt/fractus
FROM base AS mobility
COPY --from=build /environments/mobility /opt/fractus
ENTRYPOINT ["fractus"]
COPY --from=code /fractus_drones /opt/fractus
FROM base AS camera
COPY --from=build /environments/camera /opt/fractus
ENTRYPOINT ["fractus"]
COPY --from=code /fractus_drones /opt/fractus

# The simulated vehicle as a pod, for clusters without the embedded cluster's machine beside them.
FROM base AS sim
COPY --from=build /environments/sim /opt/fractus
USER 10001:10001
ENTRYPOINT ["python3", "-m", "fractus_vehicle"]
COPY --from=code /fractus_drones /opt/fractus
COPY --from=code /fractus_sim /opt/fractus

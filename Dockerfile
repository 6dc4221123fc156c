# Images of Fractus: docker build --target operator --tag localhost/fractus/operator:dev .
# Each image is Debian with a virtual environment in /opt/fractus. The code is the last layer. A release specifies BASE with a digest.
ARG BASE=debian:trixie-slim
FROM ${BASE} AS base
ARG BASE
LABEL org.opencontainers.image.base.name=${BASE}
# Reproducible builds reset the time stamps of files, so bytecode must be valid independently of time stamps.
RUN apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends python3 iproute2 nftables procps >/dev/null \
 && rm -rf /var/lib/apt/lists/* /var/cache/* /var/log/* \
 && python3 -m compileall -qf --invalidation-mode unchecked-hash /usr/lib/python3.13 \
 && echo 'fractus:x:10001:10001::/home/fractus:/bin/sh' >> /etc/passwd && echo 'fractus:x:10001:' >> /etc/group && mkdir /home/fractus && chown 10001:10001 /home/fractus
ENV PATH=/opt/fractus/bin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1

# ---- environments: the locked dependencies of each image, without the code
FROM base AS build
# CA bundle, for a proxy in front of the package index. It is mounted only during the build.
ARG SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt
ENV SSL_CERT_FILE=${SSL_CERT_FILE} PIP_CERT=${SSL_CERT_FILE} UV_PYTHON=/usr/bin/python3 UV_PYTHON_DOWNLOADS=never \
    UV_LINK_MODE=copy UV_PROJECT_ENVIRONMENT=/opt/fractus UV_COMPILE_BYTECODE=1 PYC_INVALIDATION_MODE=UNCHECKED_HASH \
    SYNC="/opt/uv/bin/uv sync --quiet --frozen --no-dev --no-install-workspace"
RUN apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends ca-certificates python3-venv >/dev/null && python3 -m venv /opt/uv \
 && /opt/uv/bin/pip install --quiet --no-cache-dir uv==0.13.8
WORKDIR /build
COPY pyproject.toml uv.lock /build/
COPY sim/pyproject.toml /build/sim/
FROM build AS component-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --extra geometry
FROM build AS operator-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --extra operator
FROM build AS agent-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --extra agent
FROM build AS mobility-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --extra mobility
FROM build AS camera-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --extra services
FROM build AS view-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --extra view
FROM build AS management-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --extra management
FROM build AS sim-environment
RUN --mount=type=cache,target=/root/.cache/uv $SYNC --package fractus-sim

# ---- code: the distributions fractus-drones and fractus-sim without dependencies; .dockerignore selects the build context
FROM build AS code
COPY . /build/
RUN --mount=type=cache,target=/root/.cache/uv /opt/uv/bin/uv build --quiet --wheel --all-packages --out-dir /wheels \
 && for name in fractus_drones fractus_sim; do \
      python3 -m venv --without-pip /opt/fractus && /opt/uv/bin/pip --python /opt/fractus install --quiet --no-compile --no-deps --no-index --find-links /wheels $name \
      && python3 -m compileall -q --invalidation-mode unchecked-hash /opt/fractus/lib && mv /opt/fractus /$name; done

# ---- images
FROM base AS unprivileged
USER 10001:10001
FROM unprivileged AS component
COPY --from=component-environment /opt/fractus /opt/fractus
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
FROM unprivileged AS operator
COPY --from=operator-environment /opt/fractus /opt/fractus
ENTRYPOINT ["python3", "-m", "fractus_operator"]
COPY --from=code /fractus_drones /opt/fractus
FROM unprivileged AS view
COPY --from=view-environment /opt/fractus /opt/fractus
ENTRYPOINT ["fractus", "view"]
COPY --from=code /fractus_drones /opt/fractus
FROM unprivileged AS management
COPY --from=management-environment /opt/fractus /opt/fractus
ENTRYPOINT ["fractus", "api"]
COPY --from=code /fractus_drones /opt/fractus
FROM base AS agent
COPY --from=agent-environment /opt/fractus /opt/fractus
ENTRYPOINT ["python3", "-m", "fractus_agent"]
COPY --from=code /fractus_drones /opt/fractus
FROM base AS mobility
COPY --from=mobility-environment /opt/fractus /opt/fractus
ENTRYPOINT ["fractus"]
COPY --from=code /fractus_drones /opt/fractus
FROM base AS camera
COPY --from=camera-environment /opt/fractus /opt/fractus
ENTRYPOINT ["fractus"]
COPY --from=code /fractus_drones /opt/fractus
FROM unprivileged AS sim
COPY --from=sim-environment /opt/fractus /opt/fractus
ENTRYPOINT ["python3", "-m", "fractus_vehicle"]
COPY --from=code /fractus_drones /opt/fractus
COPY --from=code /fractus_sim /opt/fractus

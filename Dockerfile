# Images of Fractus: operator, agent, mobility, camera, view, component (what applications build on), sim, and the examples.
#
#   docker build --target operator --tag localhost/fractus/operator:dev .
#
# Every image is one small root file system with Python, the dependencies that it alone needs in layers shared
# with the others, and the code on top, so that a change of code replaces a layer of a few hundred kilobytes.
#
# Builds of the same files give the same images, as long as BASE and the packages of Debian's archive are the same. BASE is a
# tag here, so that a build has Debian's latest corrections; a release looks up the digest behind it and gives that
# (`--build-arg BASE=debian:bookworm-slim@sha256:...`), and every image says in a label what it was given. (The labels
# org.opencontainers.image.base.* are for images that have the layers of their base, which these do not.)
ARG BASE=debian:bookworm-slim

# ---- tools: what builds the rest; nothing of it is in an image except what is copied out
FROM ${BASE} AS tools
ARG UV_VERSION=0.13.8
# Where package indexes are reached through a proxy of one's own: its CA bundle, mounted for the build only.
ARG PIP_CERT
ARG SSL_CERT_FILE
RUN apt-get update -q \
 && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends \
      python3 python3-pip busybox binutils media-types netbase >/dev/null \
 && rm -rf /var/lib/apt/lists/*
RUN python3 -m pip install --quiet --no-cache-dir --break-system-packages --root-user-action=ignore uv==${UV_VERSION}
COPY sim/fractus_cluster/images/bytecode.py /usr/local/bin/

# ---- packages: `record FOLDER PACKAGE...` writes down whose files FOLDER has, as images of distroless do: scanners read names,
# versions and checksums there, people the licences
FROM tools AS packages
RUN printf '%s\n' '#!/bin/sh -e' 'cd "$1"; shift; mkdir -p var/lib/dpkg/status.d' 'for name; do' \
      '  dpkg-query --status "$name" > "var/lib/dpkg/status.d/$name"' \
      '  cp "$(dpkg-query --control-path "$name" md5sums)" "var/lib/dpkg/status.d/$name.md5sums"' \
      '  cp -L --parents "/usr/share/doc/$name/copyright" .' \
      'done' > /usr/local/bin/record && chmod 755 /usr/local/bin/record

# ---- root: Python, the libraries it links to, a shell; no package manager, no documentation
# Python reads its library and dependencies from .pyc files alone, for sources would double them; bytecode.py leaves out what
# takes memory and is not read: 2 MB of each process. Modules for tests, and those whose libraries are not here, go.
FROM packages AS root
RUN packages='base-files gcc-12-base libc6 libgcc-s1 libstdc++6 zlib1g libssl3 libffi8 libexpat1 libbz2-1.0 liblzma5 libuuid1 \
      libsqlite3-0 python3-minimal python3.11-minimal libpython3.11-minimal libpython3.11-stdlib busybox media-types netbase' \
 && mkdir -p /out/usr/bin /out/usr/sbin /out/usr/lib /out/usr/lib64 /out/etc /out/run /out/proc /out/sys /out/dev \
      /out/var/lib /out/var/log /out/home/fractus /out/usr/local/lib/python3.11/dist-packages /out/usr/local/bin \
 && ln -s usr/bin usr/sbin usr/lib usr/lib64 /out/ && ln -s /run /out/var/run && mkdir -m 1777 /out/tmp /out/var/tmp \
 && dpkg -L $packages | sort -u \
  | grep -Ev '^/usr/share/(doc|man|locale|lintian|bug|perl5|base-files|binfmts)|/gconv/|__pycache__|/(audit|ld-)[^/]*/' \
  | grep -Ev '/python3.11/(lib2to3|pydoc_data|idlelib|tkinter|unittest/test|test/|ensurepip|config-|turtle)' \
  | grep -Ev '/lib-dynload/(_test|_ctypes_test|_xxtest|xxlimited|_crypt|_curses|_dbm|nis|readline)' \
  | while read -r path; do if [ -L "$path" ] || [ ! -d "$path" ]; then echo "$path"; fi; done \
  | grep -Ev '^/(bin|sbin|lib|lib64|var/run|var/lock)$' | xargs cp -a --parents -t /out \
 && record /out $packages \
 && ln -sf python3.11 /out/usr/bin/python3 && ln -sf python3.11 /out/usr/bin/python \
 && for name in sh ls cat ps env sleep ip wget nc vi grep top kill mkdir rm cp mv tail head id hostname; do \
      [ -e /out/usr/bin/$name ] || ln -s busybox /out/usr/bin/$name; done \
 && printf 'root:x:0:0:root:/root:/bin/sh\nnobody:x:65534:65534::/nonexistent:/bin/false\nfractus:x:10001:10001::/home/fractus:/bin/sh\n' > /out/etc/passwd \
 && printf 'root:x:0:\nnogroup:x:65534:\nfractus:x:10001:\n' > /out/etc/group \
 && printf 'hosts: files dns\npasswd: files\ngroup: files\nprotocols: files\nservices: files\n' > /out/etc/nsswitch.conf \
 && printf '#!/usr/bin/python3\nimport sys\nfrom fractus_cli.main import main\nsys.exit(main())\n' > /out/usr/local/bin/fractus \
 && chmod 755 /out/usr/local/bin/fractus && chown 10001:10001 /out/home/fractus && mkdir -m 700 /out/root \
 && python3 -X no_debug_ranges /usr/local/bin/bytecode.py /out/usr/lib/python3.11 /usr/lib/python3.11 && find /out/usr/lib/python3.11 -name '*.py' -delete

# ---- nft: the program that makes the table of direct links, and the libraries that nothing else needs
FROM packages AS nft
RUN apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends nftables >/dev/null \
 && rm -rf /var/lib/apt/lists/* \
 && libraries=/out/usr/lib/$(basename "$(dirname "$(ldconfig -p | awk '/libnftables.so.1/ {print $NF; exit}')")") \
 && mkdir -p "$libraries" /out/usr/bin && cp /usr/sbin/nft /out/usr/bin/ \
 && ldd /usr/sbin/nft | awk '$2 == "=>" && $1 !~ /^lib[cm]\.so/ {print $3}' > needed && xargs cp -L -t "$libraries" < needed \
 && record /out nftables $(xargs readlink -f < needed | sed 's,.*/,*/,' | xargs dpkg -S | cut -d : -f 1 | sort -u)

# ---- dependencies: one directory for each set, holding what the sets below it do not have already
# Of the Kubernetes client only the asynchronous half is kept, without its 700 classes: `import kubernetes` would run the
# synchronous one too, which with what it needs takes an agent 7 MB of memory and the image as much. `import kubernetes.aio` would
# run all of that half: its parts that are not used, and urllib3, take another 3 MB.
FROM tools AS dependencies
ARG SSL_CERT_FILE
RUN apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends \
      gcc libc6-dev libgfortran-12-dev liblapack-dev liblapack64-dev >/dev/null \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /build
COPY pyproject.toml uv.lock /build/
ENV UV_LINK_MODE=copy UV_PYTHON=/usr/bin/python3 UV_PYTHON_DOWNLOADS=never
# MCAP files are written with LZ4: zstandard stays out.
RUN --mount=type=cache,target=/root/.cache/uv \
    set -e; \
    for name in sdk core keys operator agent mobility services view; do \
      cd /build; extra="--extra $name"; if [ "$name" = sdk ]; then extra=; fi; \
      uv export --quiet --frozen --no-dev --no-emit-project $extra --output-file /build/$name.txt; \
      uv pip install --quiet --no-deps --require-hashes --target /deps/$name -r /build/$name.txt; \
      cd /deps/$name; \
      rm -rf bin .lock tzdata tzdata-* zstandard zstandard-* numpy/_core/_simd.* numpy/_core/include numpy/_core/lib numpy/f2py numpy/distutils numpy/_core/*_tests.* \
        cv2/gapi cffi pycparser* google/api google/cloud google/gapic google/logging google/longrunning google/type; \
      find . -path '*/tests' -prune -exec rm -rf {} +; \
      if [ -d kubernetes ]; then : > kubernetes/__init__.py; : > kubernetes/aio/__init__.py; \
        find kubernetes -mindepth 1 -maxdepth 1 ! -name aio ! -name __init__.py -exec rm -rf {} +; \
        find kubernetes/aio/client/models kubernetes/aio/client/api -type f ! -name __init__.py -delete; \
        rm -rf certifi* charset_normalizer* durationpy* oauthlib* requests* urllib3* websocket*; fi; \
      find . -name '*.so*' -type f -exec strip --strip-unneeded {} +; \
      find . \( -name '*.pyi' -o -name '*.pyx' -o -name '*.pxd' -o -name '*.c' -o -name '*.h' -o -name '*.a' \) -delete; \
    done; \
    for pair in core:sdk keys:core operator:keys agent:keys mobility:keys services:mobility view:core; do \
      name=${pair%:*}; below=${pair#*:}; cp -a /deps/$name /only-$name; \
      (cd /deps/$below && find . ! -type d -print0) | (cd /only-$name && xargs -0 rm -f); \
      find /only-$name -type d -empty -delete; \
    done; \
    cp -a /deps/sdk /only-sdk; \
    mkdir /only-geometry; cd /only-core; mv numpy* shapely* geographiclib* /only-geometry/; \
    for name in sdk core keys geometry operator agent mobility services view; do \
      python3 -X no_debug_ranges /usr/local/bin/bytecode.py /only-$name /usr/local/lib/python3.11/dist-packages; \
      find /only-$name -name '*.py' ! -path '*/cv2/config*.py' -delete; \
    done
# OpenBLAS is 28 MB of numpy and 42 MB of OpenCV, which have it for large matrices; ours are small. Each gets a library of
# the name that it is linked to, with just the routines that it calls, from Debian's reference BLAS and LAPACK (a wrong
# argument ends the program there, too). numpy's have integers of 64 bits, and names that say so.
RUN set -e; archives=/usr/lib/$(gcc -print-multiarch); \
    echo 'void abort(void); void xerbla_(void) { abort(); } void cblas_xerbla(void) { abort(); }' > errors.c; \
    replace() { library=$1; bits=$2; shift 2; \
      nm -D --defined-only "$library" | awk '{print $3}' | sort > offered; \
      nm -D --undefined-only "$@" | awk '{print $2}' | sort -u | comm -12 - offered > called; \
      { echo '{ global:'; sed 's/$/;/' called; echo 'local: *; };'; } > exported; \
      sed -E -e 's/^scipy_(.*)64_$/--defsym=&=\1/' -e t -e 's/^/--undefined=/' called > options; \
      gcc -shared -fPIC -s -o "$library" errors.c -Wl,@options,--version-script=exported,--gc-sections,--no-undefined \
        "-Wl,-soname,${library##*/},--start-group" "$archives/liblapack${bits}_pic.a" "$archives/blas$bits/libblas$bits.a" \
        "$(gcc -print-file-name=libgfortran.a)" -Wl,--end-group -lm; \
      rm -f "${library%/*}"/libgfortran-* "${library%/*}"/libquadmath-*; }; \
    replace /only-geometry/numpy.libs/libscipy_openblas64_-*.so 64 /only-geometry/numpy/*/*.so; \
    replace /only-services/opencv_python_headless.libs/libopenblasp-*.so '' /only-services/cv2/*.so
# Of OpenCV stay the cascades that are read; FFmpeg (36 MB) goes, since the camera takes its pictures from V4L2, not from
# files or streams. To load, OpenCV wants the names of its functions; OPENCV_VIDEOIO_PRIORITY_FFMPEG=0 keeps it from calls.
RUN set -e; cd /only-services/opencv_python_headless.libs; \
    find ../cv2/data -name '*.xml' ! -name '*_frontalface_alt2.xml' ! -name '*_frontalface_default.xml' ! -name '*_profileface.xml' -delete; \
    for library in libavcodec-* libavformat-* libavutil-* libswscale-*; do \
      version=$(echo "$library" | sed -E 's/^(lib[a-z]+)-.*\.so\.([0-9]+)\..*/\U\1_\2/'); \
      echo "$version { global: *; };" > /build/exported; \
      nm -D --undefined-only ../cv2/cv2.abi3.so | sed -n "s/^ *U \(.*\)@$version\$/void \1(void) { __builtin_trap(); }/p" > /build/names.c; \
      gcc -shared -fPIC -s "-Wl,--version-script=/build/exported,-soname,$library" -o "$library" /build/names.c; \
    done; \
    rm libswresample-* libdav1d-* libvpx-* libdrm-* libssl-* libcrypto-*

# ---- code: the packages and what tells Python their name, version and commands
FROM tools AS code
ARG PIP_CERT
WORKDIR /build
ENV UV_PYTHON=/usr/bin/python3 UV_PYTHON_DOWNLOADS=never
RUN python3 -m pip install --quiet --no-cache-dir --break-system-packages --root-user-action=ignore hatchling==1.33.0
# The build context is what .dockerignore lets through.
COPY . /build/
RUN uv build --quiet --wheel --no-build-isolation --out-dir /wheel \
 && uv pip install --quiet --no-deps --target /code /wheel/*.whl \
 && rm -rf /code/bin /code/.lock /code/fractus_drones-*.dist-info/RECORD /code/fractus_drones-*.dist-info/uv_cache.json \
 && python3 -m compileall -q --invalidation-mode unchecked-hash -s /code -p /usr/local/lib/python3.11/dist-packages /code \
 && assemble() { target=$1; shift; mkdir -p /images/$target; \
      for name in fractus_proto "$@"; do cp -a /code/$name /images/$target/; done; \
      cp -a /code/fractus_drones-*.dist-info /images/$target/; } \
 && assemble component fractus fractus_cli \
 && assemble operator fractus_cli fractus_core fractus_runtime fractus_operator \
 && assemble agent fractus_core fractus_runtime fractus_agent \
 && assemble services fractus fractus_cli fractus_core fractus_mavlink fractus_runtime fractus_services \
 && assemble view fractus_core fractus_runtime fractus_cli fractus_view \
 && assemble sim fractus_vehicle fractus_world

# ---- python: the common start of all images, with what the SDK needs
FROM scratch AS python
ARG BASE
LABEL dev.fractus.image.built-on=${BASE}
COPY --from=root /out /
COPY --from=dependencies /only-sdk /usr/local/lib/python3.11/dist-packages
ENV PATH=/usr/local/bin:/usr/bin:/bin LANG=C.UTF-8 PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1

# Who only reads and writes objects needs their models; who plans and judges needs geometry as well.
FROM python AS model
COPY --from=dependencies /only-core /usr/local/lib/python3.11/dist-packages

# Who signs or verifies; what agent and services of a node map of it is in memory once, as long as it is in one layer.
FROM model AS keys
COPY --from=dependencies /only-keys /usr/local/lib/python3.11/dist-packages

FROM keys AS domain
COPY --from=dependencies /only-geometry /usr/local/lib/python3.11/dist-packages

# ---- component: what applications' components start from
FROM python AS component
USER 10001:10001
WORKDIR /home/fractus
ENTRYPOINT ["python3"]
COPY --from=code /images/component /usr/local/lib/python3.11/dist-packages

FROM component AS example-traffic-monitoring
COPY examples/traffic-monitoring/*.py /app/
WORKDIR /app

FROM component AS example-field
COPY examples/field/*.py /app/
WORKDIR /app

FROM component AS example-links
COPY examples/links/*.py /app/
WORKDIR /app

FROM domain AS operator
COPY --from=dependencies /only-operator /usr/local/lib/python3.11/dist-packages
USER 10001:10001
ENTRYPOINT ["python3", "-m", "fractus_operator"]
COPY --from=code /images/operator /usr/local/lib/python3.11/dist-packages

FROM model AS view
COPY --from=dependencies /only-geometry /usr/local/lib/python3.11/dist-packages
COPY --from=dependencies /only-view /usr/local/lib/python3.11/dist-packages
USER 10001:10001
ENTRYPOINT ["fractus", "view"]
COPY --from=code /images/view /usr/local/lib/python3.11/dist-packages

# On nodes, glibc's arenas are two: one for each thread that asks at once would hold free memory of its own, 1 to 3 MB in flight.
FROM keys AS agent
ENV MALLOC_ARENA_MAX=2
COPY --from=nft /out /
COPY --from=dependencies /only-agent /usr/local/lib/python3.11/dist-packages
ENTRYPOINT ["python3", "-m", "fractus_agent"]
COPY --from=code /images/agent /usr/local/lib/python3.11/dist-packages

# What flies a drone has no libraries for pictures: those are the camera's alone.
FROM domain AS mobility-dependencies
ENV MALLOC_ARENA_MAX=2
COPY --from=dependencies /only-mobility /usr/local/lib/python3.11/dist-packages

FROM mobility-dependencies AS mobility
ENTRYPOINT ["fractus"]
COPY --from=code /images/services /usr/local/lib/python3.11/dist-packages

FROM mobility-dependencies AS camera
ENV OPENCV_VIDEOIO_PRIORITY_FFMPEG=0
COPY --from=dependencies /only-services /usr/local/lib/python3.11/dist-packages
ENTRYPOINT ["fractus"]
COPY --from=code /images/services /usr/local/lib/python3.11/dist-packages

# ---- sim: the simulated vehicle as a pod, for clusters whose nodes have no hardware beside them
FROM camera AS sim
USER 10001:10001
ENTRYPOINT ["python3", "-m", "fractus_vehicle"]
COPY --from=code /images/sim /usr/local/lib/python3.11/dist-packages

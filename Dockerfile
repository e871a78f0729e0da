# One image for every role: `docker run evedrop sensor /brief/brief.json`. docker-compose.yml starts a run of them.
# Pinned by the digest of its index, which names an image for each kind of processor (docs/containers.md says how to renew it).
ARG PINNED=python:3.11.16-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b
ARG EVEDROP_BASE

FROM ${EVEDROP_BASE:-${PINNED}} AS build
# pip stays behind with this stage: it installs from the outside into an environment that has none.
RUN python3 -m venv /build && python3 -m venv --without-pip /opt/evedrop
# build/wheels is there where packages were fetched beforehand, for a build that reaches no index (docs/containers.md).
COPY tools/constraints/project.txt build/wheels* /wheels/
# Every locked package, checked against its hash; of them what a run needs is installed, and what builds the wheel is used.
RUN if ls /wheels/*.whl >/dev/null 2>&1; then index=--no-index; fi; \
    /build/bin/pip download --quiet --disable-pip-version-check --no-cache-dir $index --find-links /wheels \
      --require-hashes --no-deps --requirement /wheels/project.txt --dest /packages
COPY pyproject.toml README.md LICENSE /source/
COPY tools/hatch_build.py /source/tools/
COPY docs /source/docs
COPY emulator /source/emulator
COPY peers /source/peers
COPY scenarios /source/scenarios
RUN /build/bin/pip --python /opt/evedrop/bin/python install --quiet --disable-pip-version-check --no-cache-dir \
      --no-index --find-links /packages /source

FROM ${EVEDROP_BASE:-${PINNED}}
# A user of no other rights; whoever starts a container may name another one.
RUN groupadd --gid 1000 evedrop && useradd --uid 1000 --gid 1000 --home-dir /tmp --no-create-home evedrop
COPY --from=build /opt/evedrop /opt/evedrop
COPY tools/containers/briefs.sh tools/containers/forward.py /opt/evedrop/
ENV PATH=/opt/evedrop/bin:$PATH PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 EVEDROP_HEARTBEAT=/tmp/evedrop-heartbeat
USER evedrop
WORKDIR /tmp
# Healthy is a process that has been on the network of its run within half a minute: it touches a file every two seconds. To ask
# the router instead (`evedrop health`) takes an interpreter, and too long on a busy machine.
HEALTHCHECK --interval=10s --timeout=30s --start-period=30s \
  CMD test -n "$(find "$EVEDROP_HEARTBEAT" -newermt '-30 seconds' 2>/dev/null)"
ENTRYPOINT ["evedrop"]
CMD ["--help"]

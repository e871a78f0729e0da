# One image for every role: `docker run evedrop sensor /brief/brief.json`. docker-compose.yml starts a run of them.
ARG BASE=python:3.11-slim

FROM ${BASE} AS build
# pip stays behind with this stage: it installs from the outside into an environment that has none.
RUN python3 -m venv /build && python3 -m venv --without-pip /opt/evedrop
# build/wheels is there where packages were fetched beforehand, for a build that reaches no index (docs/containers.md).
COPY constraints.txt build/wheels* /wheels/
# Every locked package, checked against its hash; of them what a run needs is installed, and what builds the wheel is used.
RUN if ls /wheels/*.whl >/dev/null 2>&1; then index=--no-index; fi; \
    /build/bin/pip download --quiet --disable-pip-version-check --no-cache-dir $index --find-links /wheels \
      --require-hashes --no-deps --requirement /wheels/constraints.txt --dest /packages
COPY pyproject.toml README.md LICENSE /source/
COPY emulator /source/emulator
COPY peers /source/peers
COPY scenarios /source/scenarios
RUN /build/bin/pip --python /opt/evedrop/bin/python install --quiet --disable-pip-version-check --no-cache-dir \
      --no-index --find-links /packages /source

FROM ${BASE}
# A user of no other rights; whoever starts a container may name another one.
RUN groupadd --gid 1000 evedrop && useradd --uid 1000 --gid 1000 --home-dir /tmp --no-create-home evedrop
COPY --from=build /opt/evedrop /opt/evedrop
COPY containers/briefs.sh /opt/evedrop/briefs.sh
ENV PATH=/opt/evedrop/bin:$PATH PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
USER evedrop
WORKDIR /tmp
# Healthy is who is on the network of its run, by what the router says.
HEALTHCHECK --interval=10s --timeout=10s --start-period=30s CMD ["evedrop", "health", "/brief/brief.json"]
ENTRYPOINT ["evedrop"]
CMD ["--help"]

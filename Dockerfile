# fieldtwin in a container: gateway, PLC and emulators, as one command. Needs no privilege and no kernel CAN.
#
#   docker build -t fieldtwin . && docker run --rm fieldtwin run observatory --prototype --for 20s
#
# For a real serial port or CAN interface add --device=/dev/ttyUSB0 or --network=host. docs/how-to/compose.md has the rest.
FROM python:3.11-slim-bookworm AS build
WORKDIR /src
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore
RUN python -m venv --without-pip /opt/fieldtwin
# The dependencies of fieldtwin, and its MQTT client, in a separate layer: a change of our code does not install them again.
COPY pyproject.toml ./
RUN python -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb'))['project']; print(*p['dependencies'], *p['optional-dependencies']['mqtt'], sep='\n')" \
      > /tmp/requirements.txt \
 && pip --python /opt/fieldtwin/bin/python install -r /tmp/requirements.txt
COPY . .
# parser(): keeps the parse tables of Structured Text, which the image's user cannot write (docs/decisions/0086-parse-tables.md).
# share: the folder of the shipped profiles and recordings, independent of the Python version in their path.
RUN pip --python /opt/fieldtwin/bin/python install --no-deps . \
 && /opt/fieldtwin/bin/python -c 'from fieldtwin.plc.st.syntax.grammar import parser; parser()' \
 && cd / && ln -s "$(/opt/fieldtwin/bin/python -c 'from fieldtwin.twin.site.data_files import data_root; print(data_root())')" \
      /opt/fieldtwin/share

FROM python:3.11-slim-bookworm
LABEL org.opencontainers.image.title="fieldtwin" org.opencontainers.image.licenses="Apache-2.0"
# iproute2 creates the host's vcan0 (docker-compose's profile vcan); no other part uses it.
RUN apt-get update -qq && apt-get install -y -qq --no-install-recommends iproute2 \
 && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
RUN useradd --uid 10001 --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin fieldtwin \
 && install -d -o fieldtwin -g fieldtwin -m 700 /run/fieldtwin /var/lib/fieldtwin
COPY --from=build /opt/fieldtwin /opt/fieldtwin
COPY --from=build /src/scripts/container-health /usr/local/bin/container-health
ENV PATH=/opt/fieldtwin/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
    PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 FIELDTWIN_RUN=/run/fieldtwin
USER fieldtwin
WORKDIR /
ENTRYPOINT ["fieldtwin"]
CMD ["--help"]

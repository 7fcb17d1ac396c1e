# vlc-rx with its page, in a container:
#   docker build -t vlc-rx .
#   docker run --rm -u "$(id -u)" -v "$PWD:/data" vlc-rx decode photo.jpg
#   docker run --rm -p 127.0.0.1:8017:8017 vlc-rx serve --host 0.0.0.0
# The build needs the base image and the package index, nothing else; the container itself needs no network.
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY rxcli rxcli
COPY calibration calibration
COPY models models
COPY pages pages
COPY sample_frames sample_frames
RUN pip wheel --no-cache-dir --wheel-dir /wheels '.[web]'

FROM python:3.12-slim
RUN --mount=type=bind,from=build,source=/wheels,target=/wheels \
    pip install --no-cache-dir --no-index --find-links /wheels 'vlc-rx[web]' \
    && useradd --create-home receiver && install -d -m 1777 /data
USER receiver
WORKDIR /data
ENTRYPOINT ["vlc-rx"]
CMD ["--help"]

# docker build -t naibu . && docker run --rm -v "$PWD:/data" naibu identify my_gel -k 'gel=20 kPa' -o results
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml build_commit.py README.md LICENSE ./
COPY src src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(ls /wheels/naibu-*.whl)[fast]" && rm -r /wheels
# no rights, no home folder: compiled kernels go to a folder that everybody may write to, and are part of the image
ENV NUMBA_CACHE_DIR=/var/cache/naibu MPLCONFIGDIR=/tmp
RUN install -d -m 1777 /var/cache/naibu && naibu doctor
WORKDIR /data
USER 65534:65534
ENTRYPOINT ["naibu"]
CMD ["--help"]

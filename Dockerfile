# docker build -t mmrjax . && docker run --rm -v "$PWD:/data" mmrjax loop measured --out found
FROM python:3.11-slim
COPY . /src
RUN pip install --no-cache-dir -r /src/requirements.lock && pip install --no-cache-dir --no-deps /src && rm -rf /src
WORKDIR /data
ENV MMRJAX_CACHE=/tmp/mmrjax
ENTRYPOINT ["mmrjax"]

"""A matte of a service as a Dataset: over HTTP and from its archive, and entry by entry for any zarr reader."""

from datetime import timedelta
from pathlib import Path

import dask
import envmatte
import numpy as np
import pytest
import xarray as xr
import zarr
from obstore.store import HTTPStore
from zarr.storage import ObjectStore

from services.client import NotFound, Unreachable
from storage.layout.matte_archive import block_entries
from storage.layout.mattes import FRAMES
from storage.objects.zarr_store import StrictStore
from tests.end_to_end.conftest import HEIGHT, WIDTH, Service
from tests.end_to_end.problems import check_problem
from tests.parts.rig import free_port


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """The bytes of each entry that is fetched."""
    sizes: dict[str, int] = {}
    get = StrictStore.get

    async def watched(self: StrictStore, key: str, *more: object) -> object:
        value = await get(self, key, *more)
        sizes[key.partition("/zarr/")[2]] = len(value) if value else 0
        return value

    monkeypatch.setattr(StrictStore, "get", watched)
    return sizes


def check_values(service: Service, matte: str, found: xr.Dataset) -> None:
    """A Dataset has the layers, and the lobes of pixels, that the service answers with."""
    found = found.compute()
    for name, expected in service.client.matte(matte).layers.items():
        np.testing.assert_array_equal(found[name], expected)
    for x, y in ((50, 30), (32, 24), (0, 0), (WIDTH - 1, HEIGHT - 1)):
        lobes = service.http.get(f"/v1/mattes/{matte}/transport", params={"x": x, "y": y}).json()["lobes"]
        pixel = found.isel(x=x, y=y)
        used = pixel.isel(lobe=slice(len(lobes)))
        assert len(lobes) >= 1
        assert not pixel.weight[len(lobes) :].any()
        for name in ("u", "v", "weight", "sigma_u", "sigma_v", "theta"):
            np.testing.assert_allclose(used[name], [lobe[name] for lobe in lobes], rtol=1e-6)


@pytest.mark.parametrize("url", ["{0}/v1/mattes/{1}", "{0}/v1/mattes/{1}/archive", "{0}/#/mattes/{1}"])
def test_url_opens_with_the_values_of_the_service(service: Service, matte: str, url: str) -> None:
    check_values(service, matte, envmatte.open(url.format(service.url, matte)))


def test_url_in_capitals_opens(service: Service, matte: str) -> None:
    found = envmatte.open(f"{service.url}/v1/mattes/{matte}".replace("http", "HTTP"))
    assert found.alpha[0, 0].compute().dtype == np.float32


def test_archive_opens_with_the_values_of_the_service(service: Service, matte: str, tmp_path: Path) -> None:
    file = tmp_path / "matte.zip"
    service.client.export(matte, file)
    check_values(service, matte, envmatte.open(file))
    check_values(service, matte, xr.open_dataset(str(file), engine="envmatte"))
    fewer = xr.open_dataset(str(file), engine="envmatte", drop_variables=["S", "unknown"])
    assert set(envmatte.open(file)) - set(fewer) == {"S"}


def test_url_is_read_block_by_block(service: Service, matte: str, read: dict[str, int]) -> None:
    found = envmatte.open(f"{service.url}/v1/mattes/{matte}")
    assert set(read) == {"zarr.json", *(f"{name}/zarr.json" for name in FRAMES)}
    read.clear()
    with dask.config.set(scheduler="synchronous"):
        found.rho.isel(x=slice(3), y=slice(3)).compute()
        assert set(read) == {"rho/c/0/0/0"}
        read.clear()
        found.weight.isel(x=50, y=30).compute()
    edge = found.chunks["x"][0]
    assert set(read) <= set(block_entries(30 // edge, 50 // edge))
    assert {key.partition("/")[0] for key in read} == {*FRAMES, "T"}
    assert 0 < sum(read.values()) < len(service.http.get(f"/v1/mattes/{matte}/archive").content) / 5


def test_any_zarr_reader_opens_a_matte_where_it_is(service: Service, matte: str) -> None:
    options = {"allow_http": True, "timeout": timedelta(seconds=60)}
    store = HTTPStore.from_url(f"{service.url}/v1/mattes/{matte}/zarr", client_options=options)
    group = zarr.open_group(ObjectStore(store, read_only=True), mode="r")
    assert group.attrs["width"] == WIDTH
    np.testing.assert_array_equal(group["S"][:], service.client.matte(matte).layers["S"])
    weight = group["T/0.0/weight"]
    assert isinstance(weight, zarr.Array)
    assert weight.size == group["count"][: group.attrs["block"], : group.attrs["block"]].sum()


@pytest.mark.parametrize(
    "entry",
    [
        "",
        "envmatte.json",
        "S",
        "S/c/99/0/0",
        "S/c/0/0",
        "error/c/0/0/0",
        "T/99.0/zarr.json",
        "T/0.0/S/c/0",
        "live-1",
    ],
)
def test_unknown_entry_is_not_found(service: Service, matte: str, entry: str) -> None:
    check_problem(service.http.get(f"/v1/mattes/{matte}/zarr/{entry}"), 404, "not-found")


def test_what_cannot_be_opened_is_refused_in_words(service: Service, tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="no matte"):
        envmatte.open(f"{service.url}/v1/mattes/{'0' * 32}")
    with pytest.raises(ValueError, match="not the URL of a matte: give it as http://HOST:PORT/v1/mattes/ID"):
        envmatte.open(f"{service.url}/v1/captures")
    with pytest.raises(ValueError, match="not the URL of a matte"):
        envmatte.open("ftp://127.0.0.1/v1/mattes/m")
    with pytest.raises(Unreachable, match="no answer"):
        envmatte.open(f"http://127.0.0.1:{free_port()}/v1/mattes/{'0' * 32}")
    with pytest.raises(FileNotFoundError, match="nothing"):
        envmatte.open(tmp_path / "nothing.zip")

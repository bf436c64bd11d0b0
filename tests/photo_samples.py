"""Photos with the EXIF and XMP that aircraft write: packets as in their files, numbers to choose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

DJI = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="DJI Meta Data"
    xmlns:tiff="http://ns.adobe.com/tiff/1.0/"
    xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
   tiff:Make="DJI"
   {extra}
   drone-dji:AbsoluteAltitude="{absolute:+.2f}"
   drone-dji:RelativeAltitude="{relative:+.2f}"
   drone-dji:GimbalRollDegree="{roll:+.2f}"
   drone-dji:GimbalYawDegree="{yaw:+.2f}"
   drone-dji:GimbalPitchDegree="{pitch:+.2f}"
   drone-dji:FlightRollDegree="+3.00"
   drone-dji:FlightYawDegree="+46.00"
   drone-dji:FlightPitchDegree="+1.80">
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""

#: Phantom 4 RTK and later write these beside the rest.
RTK = (
    'drone-dji:GpsLatitude="{latitude:.9f}" drone-dji:GpsLongitude="{longitude:.9f}" drone-dji:RtkFlag="50" '
    'drone-dji:RtkStdLon="0.01254" drone-dji:RtkStdLat="0.01132" drone-dji:RtkStdHgt="0.02551"'
)

PIX4D = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:Camera="http://pix4d.com/camera/1.0"
 Camera:Yaw="{yaw}" Camera:Pitch="{pitch}" Camera:Roll="{roll}" Camera:IMUYawAccuracy="4.5"
 Camera:IMUPitchAccuracy="1.5" Camera:IMURollAccuracy="1.5" Camera:GPSXYAccuracy="170/100" Camera:GPSZAccuracy="2.6">
<Camera:BandName><rdf:Seq><rdf:li>Red</rdf:li></rdf:Seq></Camera:BandName>
</rdf:Description></rdf:RDF></x:xmpmeta>"""

PARROT = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:drone-parrot="http://www.parrot.com/drone-parrot/1.0/"
 drone-parrot:CameraRollDegree="0.3" drone-parrot:CameraPitchDegree="-89.6" drone-parrot:CameraYawDegree="121.7"
 drone-parrot:DroneRollDegree="-1.2"/></rdf:RDF></x:xmpmeta>"""

SENSEFLY = """<?xpacket begin='\ufeff' id='W5M0MpCehiHzreSzNTczkc9d'?>
<x:xmpmeta xmlns:x='adobe:ns:meta/' x:xmptk='Image::ExifTool 8.71'>
<rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'>
 <rdf:Description rdf:about='' xmlns:sensefly='http://ns.sensefly.com/sensefly/1.0/'>
  <sensefly:AltitudeAMSL>319.743866000000025</sensefly:AltitudeAMSL>
  <sensefly:AltitudeWGS84>283.897003199999972</sensefly:AltitudeWGS84>
  <sensefly:Heading>60.580160140000004</sensefly:Heading>
  <sensefly:Height>71.865234375000000</sensefly:Height>
  <sensefly:Latitude>41.037345850000001</sensefly:Latitude>
  <sensefly:Longitude>-83.307620399999990</sensefly:Longitude>
  <sensefly:PitchAngle>0.725005984300000</sensefly:PitchAngle>
  <sensefly:RollAngle>-3.427739858500000</sensefly:RollAngle>
 </rdf:Description>
</rdf:RDF>
</x:xmpmeta>
<?xpacket end='w'?>"""


def dji(yaw=45.0, pitch=-89.9, roll=0.0, absolute=198.31, relative=39.8, extra=""):
    """XMP of a DJI aircraft."""
    return DJI.format(yaw=yaw, pitch=pitch, roll=roll, absolute=absolute, relative=relative, extra=extra)


def write_photo(
    path: Path,
    grey=None,
    *,
    latitude=None,
    longitude=None,
    altitude=None,
    altitude_ref=0,
    time="2016:06:23 16:31:59",
    focal35=20,
    focal=3.61,
    plane=None,
    full_width=None,
    make="DJI",
    model="FC300S",
    h_error=None,
    subsecond=None,
    xmp="",
):
    """Write a JPEG; what is None is left out."""
    grey = np.full((90, 160), 128, np.uint8) if grey is None else grey
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = f"{make}   ", model
    detail = exif.get_ifd(ExifTags.IFD.Exif)
    if time is not None:
        detail[ExifTags.Base.DateTimeOriginal] = time
    if subsecond is not None:
        detail[ExifTags.Base.SubsecTimeOriginal] = subsecond
    if focal is not None:
        detail[ExifTags.Base.FocalLength] = IFDRational(round(focal * 100), 100)
    if focal35 is not None:
        detail[ExifTags.Base.FocalLengthIn35mmFilm] = focal35
    if plane is not None:
        detail[ExifTags.Base.FocalPlaneXResolution] = IFDRational(round(plane * 1000), 1000)
        detail[ExifTags.Base.FocalPlaneResolutionUnit] = 2
    if full_width is not None:
        detail[ExifTags.Base.ExifImageWidth] = full_width
    gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
    if latitude is not None:
        gps[ExifTags.GPS.GPSLatitudeRef] = "N" if latitude >= 0 else "S"
        gps[ExifTags.GPS.GPSLatitude] = _sexagesimal(latitude)
        gps[ExifTags.GPS.GPSLongitudeRef] = "E" if longitude >= 0 else "W"
        gps[ExifTags.GPS.GPSLongitude] = _sexagesimal(longitude)
    if altitude is not None:
        gps[ExifTags.GPS.GPSAltitudeRef] = bytes([altitude_ref])
        gps[ExifTags.GPS.GPSAltitude] = IFDRational(round(abs(altitude) * 1000), 1000)
    if h_error is not None:
        gps[ExifTags.GPS.GPSHPositioningError] = IFDRational(round(h_error * 100), 100)
    Image.fromarray(grey).save(path, exif=exif, xmp=xmp.encode(), quality=97)
    return path


def _sexagesimal(degrees):
    value = abs(degrees)
    whole, minutes = int(value), int(value % 1 * 60)
    seconds = (value - whole - minutes / 60) * 3600
    return (IFDRational(whole, 1), IFDRational(minutes, 1), IFDRational(round(seconds * 1e6), 1_000_000))

//! Devices of the local network that may use a page with `--lan`. An address that is good for one device leads there;
//! the device then names itself by a cookie. Nothing is encrypted.

use std::net::{Ipv4Addr, UdpSocket};
use std::sync::{Arc, Mutex, PoisonError};

use http::StatusCode;
use qrcode::render::{svg, unicode};
use qrcode::{EcLevel, QrCode};

use crate::failure::{Failure, bail};
use crate::page::{answer, text};
use crate::say;
use crate::server::{Answer, Request};

/// Path of an address for one device, before its key.
const JOIN: &str = "/join/";
/// Name of the cookie.
const COOKIE: &str = "snapsnap";
/// Largest number of devices, those that have joined first leave first.
const MOST: usize = 16;

/// The devices, and the key for the next one.
pub struct Guests {
    /// Address of this machine in the local network.
    own: Ipv4Addr,
    port: u16,
    keys: Mutex<Keys>,
}

struct Keys {
    next: String,
    known: Vec<String>,
}

impl Guests {
    /// Without devices.
    pub fn new(port: u16) -> Result<Self, Failure> {
        let Some(own) = own_address() else {
            bail!("--lan: this machine is in no network");
        };
        Ok(Self { own, port, keys: Mutex::new(Keys { next: key()?, known: Vec::new() }) })
    }

    /// The address for the next device.
    fn address(&self) -> String {
        let keys = self.keys.lock().unwrap_or_else(PoisonError::into_inner);
        format!("http://{}:{}{JOIN}{}", self.own, self.port, keys.next)
    }

    /// Prints the address for the next device.
    pub fn invite(&self) {
        let address = self.address();
        if let Ok(code) = QrCode::with_error_correction_level(&address, EcLevel::L) {
            let mut picture = code.render::<unicode::Dense1x2>();
            say::note(
                &picture.dark_color(unicode::Dense1x2::Light).light_color(unicode::Dense1x2::Dark).build(),
            );
        }
        say::note(&format!("{address}\nleads one device of the local network here; nothing is encrypted"));
    }

    /// The address for the next device as text and as a picture (SVG) of a QR code, for the page.
    pub fn invitation(&self) -> Answer {
        let address = self.address();
        let code = QrCode::with_error_correction_level(&address, EcLevel::L);
        let picture = code.map(|code| code.render::<svg::Color>().min_dimensions(240, 240).build());
        let told = serde_json::json!({ "address": address, "picture": picture.unwrap_or_default() });
        answer("application/json", Arc::new(told.to_string()))
    }

    /// Whether a host is this machine's address in the local network.
    pub fn is_host(&self, host: &str) -> bool {
        host.parse() == Ok(self.own)
    }

    /// Whether the device has joined.
    pub fn knows(&self, request: &Request) -> bool {
        let cookies = request.header("cookie").unwrap_or_default().split(';');
        let named = cookies.filter_map(|cookie| cookie.trim().split_once('='));
        let keys = self.keys.lock().unwrap_or_else(PoisonError::into_inner);
        named.filter(|(name, _)| *name == COOKIE).any(|(_, value)| keys.known.iter().any(|key| key == value))
    }

    /// The answer to a device that joins; `None` for other requests.
    pub fn joined(&self, request: &Request) -> Option<Answer> {
        let given = request.path.strip_prefix(JOIN)?;
        let mut keys = self.keys.lock().unwrap_or_else(PoisonError::into_inner);
        let (Ok(next), Ok(known)) = (key(), key()) else {
            return Some(text(StatusCode::INTERNAL_SERVER_ERROR, "no random numbers"));
        };
        if request.method != "GET" || given != keys.next {
            let message = "this address was for one device: the program and its page show a new one";
            return Some(text(StatusCode::FORBIDDEN, message));
        }
        keys.next = next;
        if keys.known.len() == MOST {
            keys.known.remove(0);
        }
        let cookie = format!("{COOKIE}={known}; HttpOnly; SameSite=Lax; Path=/");
        keys.known.push(known);
        drop(keys);
        say::note("a device has joined; the address for the next one:");
        self.invite();
        let mut answer = text(StatusCode::SEE_OTHER, "");
        answer.headers.extend([("Set-Cookie", cookie), ("Location", "/".to_owned())]);
        Some(answer)
    }
}

/// This machine's address in the network that its packets take. None are sent.
fn own_address() -> Option<Ipv4Addr> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    // Any address outside; this one is for documentation (RFC 5737).
    socket.connect((Ipv4Addr::new(192, 0, 2, 1), 9)).ok()?;
    match socket.local_addr().ok()?.ip() {
        std::net::IpAddr::V4(address) if !address.is_loopback() && !address.is_unspecified() => Some(address),
        _ => None,
    }
}

/// 128 random bits.
fn key() -> Result<String, Failure> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(|e| Failure::Internal(format!("no random numbers: {e}")))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}
